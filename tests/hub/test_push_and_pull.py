"""Through the real client: what is pushed comes back to the byte, nothing unfinished or foreign is taken for a set."""

from __future__ import annotations

import json
import re
import shutil
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.data.conftest import make_sample
from tests.data.curating import record
from tests.hub.conftest import Repository
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError, UnavailableError
from worldline_core.publishing import pull, push
from worldline_core.store.artifact_files import digest_folder

PLACE = "hf://datasets/lab/toy"


def declare(root: Path, **changes: Any) -> None:
    """The table of sources that curation leaves."""
    row = {
        "label": "toy", "kind": "episode_set", "license": "MIT", "redistribution": "yes", "names": ["toy"], "found": 2, "kept": 2,
        "reasons": {}, "image_size": None, "fps": None, "stride": None, "conventions": {}, **changes,
    }  # fmt: skip
    (root / "sources.json").write_text(json.dumps([row]))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    samples = (make_sample(number, height=96, width=144) for number in range(2))
    root = record(tmp_path_factory.mktemp("made") / "set", samples)
    declare(root)
    return root


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "set")


def test_a_set_comes_back_to_the_byte_with_its_card(hub: Any, folder: Path, tmp_path: Path) -> None:
    pushed = push(folder, PLACE)
    repository = hub.repositories["lab/toy"]
    assert (repository.private, hub.tokens) == (True, {"hf_test"})
    assert repository.files["README.md"][0].startswith(b"---\n")
    assert not [path for path in repository.files if path.startswith("run/")]
    video = next(path for path in repository.files if path.endswith(".mp4"))
    assert repository.files[video][1]  # through LFS
    assert pull(PLACE, tmp_path / "back") == pushed
    assert digest_folder(tmp_path / "back") == digest_folder(folder)
    assert EpisodeSet.open(tmp_path / "back").frames(1, "head").shape == (9, 96, 144, 3)


def test_a_second_push_sends_only_what_changed_and_removes_what_is_gone(hub: Any, folder: Path, tmp_path: Path) -> None:
    (folder / "extra.txt").write_text("new")
    push(folder, PLACE)
    uploads = hub.count("PUT", "/lfs/")
    assert uploads > 0
    push(folder, PLACE)
    assert hub.count("PUT", "/lfs/") == uploads
    assert "extra.txt" in hub.repositories["lab/toy"].files
    (folder / "extra.txt").unlink()
    push(folder, PLACE)
    pull(PLACE, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(folder)


def test_an_interrupted_push_leaves_what_was_published_and_continues(hub: Any, folder: Path, tmp_path: Path) -> None:
    """The second upload is refused, then the commit; the third run sends only what is missing. The push goes to a branch of its own."""
    seen, place = set[str](), f"{PLACE}@v1"

    def refuse_second_object(method: str, path: str) -> int | None:
        if method == "PUT":
            seen.add(path)
        return 400 if method == "PUT" and len(seen) > 1 else None

    hub.refuse = refuse_second_object
    with pytest.raises(ArtifactError, match="did not finish the push"):
        push(folder, place)
    first = set(hub.objects)
    hub.refuse = lambda method, path: 400 if method == "POST" and "/commit/" in path else None
    with pytest.raises(ArtifactError, match="did not finish the push"):
        push(folder, place)
    hub.refuse = lambda method, path: None
    with pytest.raises(ArtifactError, match="No finished EpisodeSet is published"):
        pull(place, tmp_path / "early")
    assert not (tmp_path / "early").exists()
    hub.requests.clear()
    push(folder, place)
    again = {path.removeprefix("/lfs/") for method, path in hub.requests if method == "PUT"}
    assert not again & first
    assert hub.count("POST", "/branch/v1") == 1
    assert {path.rpartition("/")[2] for method, path in hub.requests if "/commit/" in path} == {"v1"}
    pull(place, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(folder)


def test_a_pull_continues_and_a_changed_file_is_found(hub: Any, folder: Path, tmp_path: Path) -> None:
    push(folder, PLACE)
    repository = hub.repositories["lab/toy"]
    video = next(path for path in repository.files if path.endswith(".mp4"))
    hub.refuse = lambda method, path: 400 if method == "GET" and path.endswith(".mp4") else None
    with pytest.raises(ArtifactError, match="did not finish the pull"):
        pull(PLACE, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    hub.refuse = lambda method, path: None
    hub.requests.clear()
    pull(PLACE, tmp_path / "back")
    assert hub.count("GET", "/resolve/") < len(repository.files)  # the rest had arrived
    content, lfs = repository.files[video]
    repository.files[video] = content[:-1] + bytes([content[-1] ^ 1]), lfs
    repository.commits.append("f" * 40)
    with pytest.raises(ArtifactError, match=r"(?s)not those of the set.*mp4"):
        pull(PLACE, tmp_path / "changed")
    assert not (tmp_path / "changed").exists()
    push(folder, PLACE)  # sends the changed file anew
    repository.files["stray.txt"] = b"?", False
    pull(PLACE, tmp_path / "changed")
    assert digest_folder(tmp_path / "changed") == digest_folder(folder)


def test_a_pull_that_was_killed_goes_on_without_damage_and_notes_of_the_client(
    hub: Any, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "x.txt").write_text("of the set")
    push(folder, PLACE)
    hub.repositories["lab/toy"].files["[x].txt"] = b"a stray whose name is a pattern", False

    def killed(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shutil, "rmtree", killed)  # when everything has arrived
        pull(PLACE, tmp_path / "back")
    unfinished = tmp_path / "back.partial"
    assert (unfinished / ".cache").is_dir()
    next(unfinished.glob("datasets/**/*.mp4")).write_bytes(b"cut")  # of which the notes say that it is complete
    pull(PLACE, tmp_path / "back")
    assert digest_folder(tmp_path / "back") == digest_folder(folder)
    assert not (tmp_path / "back/.cache").exists()


LISTED = b'{"type": "file", "path": "worldline_files.json", "oid": "a", "size": '
ODD = (
    b"", b"[]", b"null", b"3", b"\xff", b"[" * 100_000, b'{"sha": 3}', b'{"id": "a/b", "sha": "../../x", "siblings": []}',
)  # fmt: skip
ODD_ANSWERS = (
    *((part, body) for part in (r"/toy$", "/tree/") for body in ODD),
    *(("/tree/", body) for body in (
        b"[1]", b'[{"type": "file"}]', b'[{"type": "x", "path": "a"}]',
        b'[{"type": "file", "path": 3, "size": 1, "oid": "a"}]',
        *(b"[" + LISTED + size + b"}]" for size in (b'"3"', b"null", b"[]", b"1e400", b"-1", b"3000000000")),
    )),
)  # fmt: skip


def test_odd_answers_end_in_one_message(hub: Any, folder: Path, tmp_path: Path, subtests: pytest.Subtests) -> None:
    push(folder, PLACE)
    for part, answer in ODD_ANSWERS:
        with subtests.test(part=part, answer=answer[:80]):
            hub.instead = lambda method, path, p=part, body=answer: body if re.search(p, path) else None
            with pytest.raises(ArtifactError, match=r"did not finish the pull|No finished EpisodeSet|List of files is"):
                pull(PLACE, tmp_path / "back")


def test_the_token_is_sent_to_the_hub_alone(hub: Any, folder: Path, tmp_path: Path) -> None:
    push(folder, PLACE)
    elsewhere: list[str | None] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            elsewhere.append(self.headers.get("authorization"))
            self.send_error(404)

    with ThreadingHTTPServer(("localhost", 0), Handler) as other:
        threading.Thread(target=other.serve_forever, args=(0.01,), daemon=True).start()
        address = f"http://localhost:{other.server_port}/x"
        for asked in (("GET",), ("GET", "HEAD")):  # without the hub's headers the client follows nowhere
            hub.instead = lambda method, path, asked=asked: (
                address if method in asked and path.endswith(".mp4") else None
            )
            with pytest.raises(ArtifactError, match="did not finish the pull"):
                pull(PLACE, tmp_path / "back")
        other.shutdown()
    assert elsewhere
    assert set(elsewhere) == {None}


@pytest.mark.parametrize(
    ("declared", "public", "message"),
    [
        ({"redistribution": "no", "license": "CC-BY-NC-SA-4.0"}, False, r"toy \(CC-BY-NC-SA-4\.0\)"),
        ({"redistribution": "unknown"}, True, r"do not state whether.*toy \(MIT\)"),
        ({}, False, "for evaluation only"),
        (None, True, "do not state whether"),
    ],
)
def test_licences_are_kept(hub: Any, folder: Path, declared: Any, public: bool, message: str) -> None:
    (folder / "sources.json").unlink()
    if declared is not None:
        declare(folder, **declared)
    if declared == {}:
        write_index(folder, [replace(row, conventions='{"layout": "robotwin"}') for row in read_index(folder)])
    with pytest.raises(DataError, match=f"(?s){message}.*--allow-restricted"):
        push(folder, PLACE, public=public)
    assert hub.requests == []  # nothing was sent, not even the repository made
    push(folder, PLACE, public=public, allow_restricted=True)
    assert hub.repositories["lab/toy"].private is not public


def test_visibility_rights_tokens_and_names(hub: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    push(folder, PLACE, public=True)
    with pytest.raises(ArtifactError, match=r"(?s)expected: private.*got: public"):
        push(folder, PLACE)
    hub.refuse = lambda method, path: 403 if path == "/api/repos/create" else None
    with pytest.raises(ArtifactError, match="HF_TOKEN"):
        push(folder, "hf://datasets/lab/forbidden")
    with pytest.raises(ArtifactError, match="did not finish the pull"):
        pull("hf://datasets/lab/nothing", folder.with_name("x"))
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(UnavailableError, match="HF_TOKEN"):
        push(folder, PLACE)
    for text in ("hf://lab/toy", "hf://datasets/toy", "hf://https://x/y", "hf://datasets/a/b/c"):
        with pytest.raises(ConfigError, match="Not a place on the hub"):
            pull(text, folder.with_name("x"))


def test_files_of_others_are_left_alone_and_of_other_artifacts_are_not_pushed(hub: Any, folder: Path) -> None:
    hub.repositories["lab/toy"] = Repository(private=True, files={"thesis.txt": (b"keep", False)})
    with pytest.raises(ArtifactError, match=r"(?s)files that are not of this set.*thesis\.txt"):
        push(folder, PLACE)
    assert hub.repositories["lab/toy"].files["thesis.txt"][0] == b"keep"
    hub.requests.clear()
    linked = folder.with_name("linked")
    linked.mkdir()
    write_index(linked, [replace(row, dataset=f"../{folder.name}/{row.dataset}") for row in read_index(folder)])
    with pytest.raises(ArtifactError, match=r"(?s)datasets of another artifact.*worldline export"):
        push(linked, PLACE)
    assert hub.requests == []
