"""An S3 server on this machine (moto's, over real HTTP) that can be told to misbehave."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

BUCKET = "recordings"
ERROR = "<Error><Code>{}</Code><Message>We encountered an error</Message></Error>"

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_MAX_ATTEMPTS": "3",
}


class ObjectStore:
    """moto behind a gate: `misbehave` is asked before each request and may answer in its place.

    Attributes:
        requests: (method, path) of all requests so far.
    """

    def __init__(self) -> None:
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import make_server

        self._moto = DomainDispatcherApplication(create_backend_app)
        self._server = make_server("127.0.0.1", 0, self, threaded=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self.requests: list[tuple[str, str]] = []
        self.misbehave: Callable[[str, str], str | None] = lambda method, path: None
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        self.requests.append((method, path))
        match self.misbehave(method, path):
            case "busy":
                start_response("503 Service Unavailable", [("Content-Type", "application/xml")])
                return [ERROR.format("SlowDown").encode()]
            case "broken":
                start_response("500 Internal Server Error", [("Content-Type", "application/xml")])
                return [ERROR.format("InternalError").encode()]
            case "hang up":
                environ["werkzeug.socket"].shutdown(2)
                return []
        return self._moto(environ, start_response)

    def upload(self, folder: Path, prefix: str) -> str:
        """Copy a folder into the bucket; returns its URL."""
        import s3fs

        store = s3fs.S3FileSystem()
        if not store.exists(BUCKET):
            store.mkdir(BUCKET)
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            store.pipe_file(f"{BUCKET}/{prefix}/{file.relative_to(folder).as_posix()}", file.read_bytes())
        return f"s3://{BUCKET}/{prefix}"

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
