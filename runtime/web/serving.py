"""A server for the page's folder on this machine."""

import functools
import sys
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

# Without these two, browsers give WebAssembly one thread. Other hosts need not send them: a service worker adds them.
ISOLATION = {"Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp"}


class PageHandler(SimpleHTTPRequestHandler):
    """Serves files with the types that browsers insist on, and isolates the page."""

    extensions_map = {  # noqa: RUF012  # as the base class has it
        **SimpleHTTPRequestHandler.extensions_map,
        ".js": "text/javascript",
        ".mjs": "text/javascript",
        ".wasm": "application/wasm",
        ".gz": "application/octet-stream",
    }

    def end_headers(self) -> None:
        """Add the headers of every answer."""
        for name, value in {**ISOLATION, "Cache-Control": "no-cache"}.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


class PageServer(ThreadingHTTPServer):
    """Says nothing of clients that close their connection, as browsers do with a page that is left."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the traceback of other errors."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def page_server(folder: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of a folder; `serve_forever` runs it. Raises OSError if the port is in use."""
    return PageServer((host, port), functools.partial(PageHandler, directory=str(folder)))
