"""A small hub on the loopback: the HTTP endpoints that huggingface_hub's client uses for dataset repositories, and those it fetches models by.

Repositories live in memory. Large files go through the LFS batch protocol, small ones inside of the commit, as on the real
hub; the newer chunk storage (xet) is switched off in the client. Faults are put in by `refuse` and `instead`.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

LFS_FROM_BYTES = 2048


@dataclass
class Repository:
    private: bool
    files: dict[str, tuple[bytes, bool]] = field(
        default_factory=lambda: {".gitattributes": (b"*.mp4 filter=lfs\n", False)}
    )
    """Path -> content, and whether it went through LFS."""
    commits: list[str] = field(default_factory=lambda: ["0" * 40])


@dataclass
class Hub:
    """State of the server.

    Attributes:
        refuse: the status to answer instead, or None, by method and path.
        instead: a body to answer instead, pieces to send as long as they are taken, an address to redirect to, or None.
    """

    repositories: dict[str, Repository] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)
    requests: list[tuple[str, str]] = field(default_factory=list)
    tokens: set[str] = field(default_factory=set)
    refuse: Callable[[str, str], int | None] = lambda method, path: None
    instead: Callable[[str, str], bytes | Iterator[bytes] | str | None] = lambda method, path: None
    url: str = ""

    def count(self, method: str, part: str) -> int:
        return sum(1 for m, path in self.requests if m == method and part in path)


def blob_oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()  # noqa: S324 - git's name of a blob


def name_of(content: bytes, lfs: bool) -> str:
    return hashlib.sha256(content).hexdigest() if lfs else blob_oid(content)


def files_of(folder: Path, *, lfs: bool = False) -> dict[str, tuple[bytes, bool]]:
    """Return the files of a folder as a repository keeps them."""
    return {p.relative_to(folder).as_posix(): (p.read_bytes(), lfs) for p in folder.rglob("*") if p.is_file()}


def handler_of(hub: Hub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True  # the body would wait 40 ms for the client to acknowledge the headers

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
            del format, args

        def endless(self, pieces: Iterator[bytes]) -> None:
            self.send_response(200)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            self.close_connection = True
            with suppress(ConnectionError):
                for piece in pieces:
                    self.wfile.write(b"%x\r\n%s\r\n" % (len(piece), piece))

        def answer(self, content: Any = None, status: int = 200, headers: dict[str, str] | None = None) -> None:
            data = content if isinstance(content, bytes) else json.dumps({} if content is None else content).encode()
            self.send_response(status)
            for name, value in {"Content-Length": str(len(data)), **(headers or {})}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

        def missing(self, code: str) -> None:
            self.answer({"error": code}, 404, {"X-Error-Code": code})

        def serve(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            path = unquote(urlsplit(self.path).path)
            hub.requests.append((self.command, path))
            if self.headers.get("authorization"):
                hub.tokens.add(self.headers["authorization"].removeprefix("Bearer "))
            status = hub.refuse(self.command, path)
            if status is not None:
                return self.answer({"error": "refused by the test"}, status)
            body_instead = hub.instead(self.command, path)
            if isinstance(body_instead, str):
                return self.answer(b"", 302, {"Location": body_instead})
            if isinstance(body_instead, bytes):
                return self.answer(body_instead)
            if body_instead is not None:
                return self.endless(body_instead)
            if self.command == "PUT" and path.startswith("/lfs/"):
                return self.put_object(path.removeprefix("/lfs/"), body)
            if path == "/api/repos/create":
                return self.create(json.loads(body))
            if path in ("/api/validate-yaml", "/lfs/verify"):
                return self.answer({"errors": [], "warnings": []})
            name, rest = self.repository(path)
            if name not in hub.repositories:
                return self.missing("RepoNotFound")
            return self.inside(hub.repositories[name], name, rest, body)

        do_GET = do_HEAD = do_POST = do_PUT = serve  # noqa: N815

        def repository(self, path: str) -> tuple[str, str]:
            """ORG/NAME, and what comes after it."""
            owner, name, *rest = [*re.sub("^(/api)?(/datasets|/models)?/", "", path).split("/", 2), "", ""]
            return f"{owner}/{name.removesuffix('.git')}", rest[0]

        def create(self, wanted: dict[str, Any]) -> None:
            assert wanted["type"] == "dataset"
            name = f"{wanted.get('organization') or 'me'}/{wanted['name']}"
            if name in hub.repositories:
                return self.answer({"error": "exists", "url": f"{hub.url}/datasets/{name}"}, 409)
            private = bool(wanted.get("private")) or wanted.get("visibility") == "private"
            hub.repositories[name] = Repository(private)
            return self.answer({"url": f"{hub.url}/datasets/{name}", "name": name})

        def put_object(self, oid: str, body: bytes) -> None:
            assert hashlib.sha256(body).hexdigest() == oid
            hub.objects[oid] = body
            self.answer({})

        def inside(self, repository: Repository, name: str, rest: str, body: bytes) -> None:
            head, _, tail = rest.partition("/")
            if head in ("", "revision"):
                listed = [{"rfilename": path} for path in repository.files]
                info = {"id": name, "sha": repository.commits[-1], "private": repository.private, "siblings": listed}
                return self.answer(info)
            if head == "preupload":
                return self.answer({"files": [self.mode(repository, each) for each in json.loads(body)["files"]]})
            if head == "info":
                return self.batch(json.loads(body))
            if head == "commit":
                return self.commit(repository, name, body)
            if head == "branch":
                return self.answer({})
            if head == "tree":
                return self.answer([self.entry(path, *found) for path, found in sorted(repository.files.items())])
            assert head == "resolve", rest
            return self.resolve(repository, tail.partition("/")[2])

        def mode(self, repository: Repository, each: dict[str, Any]) -> dict[str, Any]:
            oid = name_of(*repository.files[each["path"]]) if each["path"] in repository.files else None
            mode = "lfs" if each["size"] >= LFS_FROM_BYTES else "regular"
            return {"path": each["path"], "uploadMode": mode, "shouldIgnore": False, "oid": oid}

        def batch(self, wanted: dict[str, Any]) -> None:
            for each in wanted["objects"]:
                if each["oid"] not in hub.objects:
                    places = {"upload": f"{hub.url}/lfs/{each['oid']}", "verify": f"{hub.url}/lfs/verify"}
                    each["actions"] = {action: {"href": place} for action, place in places.items()}
            self.answer({"transfer": "basic", "objects": wanted["objects"]})

        def commit(self, repository: Repository, name: str, body: bytes) -> None:
            changed = dict(repository.files)
            for item in map(json.loads, body.splitlines()):
                match item["key"], item["value"]:
                    case "file", value:
                        changed[value["path"]] = base64.b64decode(value["content"]), False
                    case "lfsFile", value:
                        changed[value["path"]] = hub.objects[value["oid"]], True
                    case "deletedFile", value:
                        del changed[value["path"]]
            repository.files = changed
            repository.commits.append(hashlib.sha1(body + repository.commits[-1].encode()).hexdigest())  # noqa: S324
            oid = repository.commits[-1]
            self.answer({"success": True, "commitOid": oid, "commitUrl": f"{hub.url}/datasets/{name}/commit/{oid}"})

        def entry(self, path: str, content: bytes, lfs: bool) -> dict[str, Any]:
            found: dict[str, Any] = {"type": "file", "path": path, "size": len(content), "oid": blob_oid(content)}
            if lfs:
                found["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
            return found

        def resolve(self, repository: Repository, path: str) -> None:
            if path not in repository.files:
                return self.missing("EntryNotFound")
            content, lfs = repository.files[path]
            headers = {"ETag": f'"{name_of(content, lfs)}"', "X-Repo-Commit": repository.commits[-1]}
            if self.command == "HEAD":
                sizes = dict.fromkeys(("Content-Length", "X-Linked-Size"), str(len(content)))
                return self.answer(b"", 200, headers | sizes)
            return self.answer(content, 200, headers)

    return Handler


class _Server(ThreadingHTTPServer):
    request_queue_size = 64  # the client opens a connection a thread
    daemon_threads = True


@pytest.fixture(scope="session")
def served() -> Iterator[Hub]:
    """A running hub. One for all tests: at another address, what reads recordings would be started again."""
    state = Hub()
    server = _Server(("127.0.0.1", 0), handler_of(state))
    state.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield state
    server.shutdown()
    server.server_close()
    thread.join(timeout=10)


@pytest.fixture
def hub(served: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Hub:
    """An empty hub that the client is pointed at."""
    import huggingface_hub.constants as constants

    Hub.__init__(served, url=served.url)
    monkeypatch.setenv("HF_ENDPOINT", served.url)
    monkeypatch.setenv("HF_TOKEN", "hf_test")
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    return served
