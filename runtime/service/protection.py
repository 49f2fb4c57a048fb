"""Who may ask, how slowly a client may send and read, and the headers of every answer."""

import hmac
from asyncio import TimerHandle, Transport
from collections.abc import Callable
from typing import Any

import h11
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..viewer.server import is_own_page

OPEN_PATHS = ("/", "/health", "/ready", "/openapi.json")  # and the page's files: no token is asked for
PAGE = "/page/"
HEADER_S = 10.0  # until the headers of a request are there
WRITE_S = 60.0  # that a client may leave an answer unread
# That a request is read on after it was answered: closing at once would reset the connection, and lose the answer.
LINGER_S = 10.0
MAX_HEADER_BYTES = 16384
BEARER = "Bearer "
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'self'",
}


class Protection:
    """An ASGI application that lets through what may be asked.

    With a token, requests need `Authorization: Bearer TOKEN`, but for the page and the probes. Without one, only
    requests to a name of this machine that come from no other page are answered (see `viewer.server`).
    count: told the status of every answer.
    """

    def __init__(self, app: ASGIApp, host: str, token: str | None, count: Callable[[int], None]) -> None:
        self._app, self._host, self._token, self._count = app, host, token, count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._count(message["status"])
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope)
        await (refusal or self._app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers, path = Headers(scope=scope), scope["path"]
        if len(path) + sum(len(name) + len(value) for name, value in headers.raw) > MAX_HEADER_BYTES:
            return JSONResponse({"detail": f"the headers are larger than {MAX_HEADER_BYTES} bytes"}, 431)
        if self._token is None:
            if not is_own_page(self._host, headers.get("host"), headers.get("origin")):
                return JSONResponse({"detail": "only this machine, and the page that is served here, may ask"}, 403)
            return None
        if path in OPEN_PATHS or path.startswith(PAGE) or self._is_allowed(headers.get("authorization", "")):
            return None
        detail = {"detail": "a token is needed: the header `Authorization: Bearer TOKEN`"}
        return JSONResponse(detail, 401, {"WWW-Authenticate": "Bearer"})

    def _is_allowed(self, authorization: str) -> bool:
        given = authorization[len(BEARER) :] if authorization[: len(BEARER)].lower() == BEARER.lower() else ""
        return hmac.compare_digest(given.strip().encode(), (self._token or "").encode())


class TimedProtocol(H11Protocol):
    """uvicorn's protocol, with limits on the time that a client takes to send headers and to read answers."""

    _header_timer: TimerHandle | None = None
    _write_timer: TimerHandle | None = None
    _linger_timer: TimerHandle | None = None

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        """Begin to wait for the headers."""
        super().connection_made(transport)
        self._watch_headers()

    def data_received(self, data: bytes) -> None:
        """Take what comes; headers in small pieces gain no time."""
        super().data_received(data)
        self._watch_headers()
        if self._linger_timer is not None and self.conn.their_state is not h11.SEND_BODY:
            self._linger_timer.cancel()
            self._linger_timer = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the timers."""
        super().connection_lost(exc)
        for timer in (self._header_timer, self._write_timer, self._linger_timer):
            if timer is not None:
                timer.cancel()

    def on_response_complete(self) -> None:
        """Read the rest of a request that was refused before its end, for a while."""
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY and self._linger_timer is None:
            self._linger_timer = self.loop.call_later(LINGER_S, self.transport.close)

    def pause_writing(self) -> None:
        """The client does not read as fast as is written."""
        super().pause_writing()
        if self._write_timer is None:
            self._write_timer = self.loop.call_later(WRITE_S, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read."""
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def _watch_headers(self) -> None:
        waits = self.conn.their_state is h11.IDLE and not self.transport.is_closing()
        if waits and self._header_timer is None:
            self._header_timer = self.loop.call_later(HEADER_S, self._refuse_slow)
        elif not waits and self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None

    def _refuse_slow(self) -> None:
        self._header_timer = None
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            return
        events: list[Any] = [
            h11.Response(status_code=408, headers=[(b"connection", b"close"), (b"content-length", b"0")]),
            h11.EndOfMessage(),
        ]
        for event in events:
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
