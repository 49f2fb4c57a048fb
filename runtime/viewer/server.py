"""A free port for the viewer's server, and protection against requests from other web pages.

Any page in a browser may send requests to this machine. The headers `Origin` and `Host` hold where a request comes from
and which name it is addressed to. A page of another server has another origin. With DNS rebinding, where an attacker
lets their name resolve to this machine, the origin fits, but the name is not one of this machine's.
"""

import contextlib
import errno
import ipaddress
import socket
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from ..errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

PORTS_TRIED = 100
HIGHEST_PORT = 65535
LOCAL_NAME = "localhost"


def free_port(host: str, port: int) -> int:
    """The first free port from `port` on; 0, for any, stays 0.

    Raises InputError if the host is not an address of this machine, or no port is free.
    """
    if not host:
        raise InputError("--host is empty; expected an address such as 127.0.0.1, or 0.0.0.0 for all of this machine's")
    last = min(port + PORTS_TRIED, HIGHEST_PORT + 1) if port else 1
    for candidate in range(port, last):
        try:
            _try_port(host, candidate)
        except (OSError, UnicodeError) as error:
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                continue
            reason = str(getattr(error, "strerror", None) or error).split(" (")[0]
            place = f"{host} port {candidate}"
            raise InputError(f"cannot serve at {place}: {reason}; choose another --host or --port") from None
        return candidate
    busy = f"ports {port} to {last - 1} are in use"
    raise InputError(f"cannot serve at {host}: {busy}; choose another --port, or 0 for any")


def address(host: str, port: int) -> str:
    """The URL of the page for a browser on this machine."""
    name = f"[{host}]" if ":" in host else host
    if _is_unspecified(host):  # all addresses of this machine: a browser needs one
        name = "[::1]" if ":" in host else "127.0.0.1"
    return f"http://{name}:{port}"


@contextlib.contextmanager
def only_own_page(host: str) -> Iterator[None]:
    """Let a websockets server that is started in the block, at `host`, answer only its own page.

    viser starts one and has no other hook for checking requests. Raises RuntimeError if none was started.
    """
    import websockets.asyncio.server as server

    original, started = server.serve, False

    def serve(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        nonlocal started
        started = True
        return original(*args, process_request=_guarded(host, process_request), **options)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
    if not started:
        raise RuntimeError("this version of viser starts another server, which is not protected")


def is_own_page(host: str, asked: str | None, origin: str | None) -> bool:
    """Whether a request is addressed to a server at `host` and comes from its own page.

    asked, origin: the request's headers `Host` and `Origin`. Without an origin only the host is checked.
    """
    if asked is None or not _is_own_name(host, asked):
        return False
    return origin is None or origin.lower() == f"http://{asked.lower()}"


def _guarded(host: str, answer: Callable[..., Any] | None) -> "Callable[[ServerConnection, Request], Any]":
    def process_request(connection: "ServerConnection", request: "Request") -> "Response | Any":
        """Answer 403 to requests from other pages; the page's own WebSocket always has an origin."""
        asked, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        upgrade = "Upgrade" in request.headers
        single = len(asked) == 1 and len(origins) <= 1 and (origins or not upgrade)
        if not single or not is_own_page(host, asked[0], origins[0] if origins else None):
            return connection.respond(403, "Only the page that is served here may ask.\n")
        return answer(connection, request) if answer else None

    return process_request


def _try_port(host: str, port: int) -> None:
    """Bind a port at every address of the host, as the server does; raises OSError, UnicodeError."""
    with contextlib.ExitStack() as stack:
        for family, kind, protocol, _, place in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            bound = stack.enter_context(socket.socket(family, kind, protocol))
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                bound.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            bound.bind(place)
            bound.listen(1)


def _is_own_name(host: str, asked: str) -> bool:
    """Whether a `Host` header names this machine: an IP address, localhost, or the name given by --host."""
    try:
        name = urlsplit(f"//{asked}").hostname
    except ValueError:
        return False
    if not name:
        return False
    name = name.rstrip(".")
    own = {LOCAL_NAME, host.lower()}
    if _is_unspecified(host):
        own |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return name in own or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_unspecified(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host).is_unspecified
