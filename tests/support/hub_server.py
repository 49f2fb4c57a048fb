"""The Hugging Face hub's HTTP interface for downloads, on the loopback address."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@dataclass
class Hub:
    """A server's files by `owner/name/resolve/revision/file`, and what was asked of it.

    cut: after this many bytes it breaks off the next transfer; 0 for never. closed: it then refuses to send more.
    url: where it is.
    """

    files: dict[str, bytes]
    cut: int = 0
    closed: bool = False
    url: str = ""
    requests: list[tuple[str, str, str]] = field(default_factory=list)  # method, path, range
    commit: str = COMMIT
    etag: str = ""  # instead of the file's SHA-256


@contextmanager
def serve_hub(files: dict[str, bytes], cut: int = 0) -> Iterator[Hub]:
    """Serve files until the block ends."""
    hub = Hub(files, cut)

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self.answer(with_content=False)

        def do_GET(self) -> None:
            self.answer(with_content=True)

        def answer(self, with_content: bool) -> None:
            asked = self.headers.get("Range", "")
            hub.requests.append((self.command, self.path, asked))
            content = hub.files.get(self.path.lstrip("/"))
            if hub.closed:
                self.send_response(403)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            if content is None:
                self.send_response(404)
                self.send_header("X-Error-Code", "EntryNotFound")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            start = int(asked.removeprefix("bytes=").partition("-")[0] or 0)
            self.send_response(206 if start else 200)
            self.send_header("X-Repo-Commit", hub.commit)
            self.send_header("ETag", f'"{hub.etag or hashlib.sha256(content).hexdigest()}"')
            self.send_header("Accept-Ranges", "bytes")
            self.send_header("Content-Length", str(len(content) - start))
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
            self.end_headers()
            if not with_content:
                return
            part = content[start:]
            if hub.cut:
                part, hub.cut, hub.closed = part[: hub.cut], 0, True
                self.close_connection = True
            self.wfile.write(part)

        def log_message(self, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
