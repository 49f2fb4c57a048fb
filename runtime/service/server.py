"""Running a service on uvicorn until it is asked to stop."""

import asyncio
import logging
import socket
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn

from ..errors import InputError
from ..system.files import check_writable, make_folder, scratch_folder
from ..viewer.server import address
from .app import make_app
from .protection import MAX_HEADER_BYTES, TimedProtocol
from .service import Service, Settings

LOG = logging.getLogger(__name__)

MAX_CONNECTIONS = 1000
CLOSE_S = 5  # that answers which are being sent have, when everything else is done
BACKLOG = 512


class Server(uvicorn.Server):
    """A server that lets running jobs finish when it is first asked to stop, and stops when it is asked again."""

    def __init__(self, config: uvicorn.Config, asked: asyncio.Event) -> None:
        super().__init__(config)
        self._asked, self._loop = asked, asyncio.get_running_loop()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Take note of a signal; it is not raised again afterwards, since stopping is what was asked for."""
        if self._asked.is_set():
            self.should_exit = self.force_exit = True
        self._loop.call_soon_threadsafe(self._asked.set)


def serve(settings: Settings, storage: Path | None, on_start: Callable[[str], None]) -> None:
    """Serve until SIGINT or SIGTERM.

    storage: the folder for the jobs' files, in a folder of their own that is removed at the end; None for the system's
    for temporary files. on_start: called with the service's address.
    Raises InputError if the address or the folder cannot be used, or the model cannot be opened.
    """
    with _listen(settings) as listener:
        if storage is not None:
            check_writable(make_folder(storage))
        with scratch_folder(storage) as folder:
            asyncio.run(_serve(settings, listener, folder, on_start))


async def _serve(settings: Settings, listener: socket.socket, folder: Path, on_start: Callable[[str], None]) -> None:
    async with Service.running(settings, folder) as service:
        asked = asyncio.Event()
        config = uvicorn.Config(
            make_app(service),
            http=TimedProtocol,
            loop="asyncio",
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=CLOSE_S,
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
            backlog=BACKLOG,
        )
        server = Server(config, asked)
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        stopping = asyncio.create_task(asked.wait())
        on_start(address(settings.host, listener.getsockname()[1]))
        try:
            ends: list[asyncio.Future[Any]] = [serving, stopping, service.pool.failure]
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            if asked.is_set():
                LOG.info("stopping: %d scenes run", len(service.jobs.running))
                draining = asyncio.create_task(service.stop())
                await asyncio.wait({serving, draining}, return_when=asyncio.FIRST_COMPLETED)
                draining.cancel()
            server.should_exit = True
            await serving
            if service.pool.failure.done() and not service.pool.failure.cancelled():
                service.pool.failure.result()
        finally:
            stopping.cancel()


def _listen(settings: Settings) -> socket.socket:
    """A socket that listens at the service's address. Raises InputError."""
    try:
        family = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((settings.host, settings.port), family=family, backlog=BACKLOG)
    except (OSError, UnicodeError) as error:
        reason = str(getattr(error, "strerror", None) or error).split(" (")[0]
        raise InputError(
            f"cannot serve at {settings.host} port {settings.port}: {reason}; choose another --host or --port"
        ) from None
