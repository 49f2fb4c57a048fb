"""The engine on Ray: a pool of actors, each with one opened model. Paths pass through Ray, never pixels."""

import logging
import os
import secrets
import signal
import socket
import tempfile
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import InputError, one_line
from ..system.files import scratch_folder
from .scenes import Scene
from .worker import Outcome, Settings, record_killed, start_worker

LOG = logging.getLogger(__name__)

INSTALL = "pip install 'idesplat[ray]'"
OBJECT_STORE_BYTES = 80 << 20  # near the least that Ray takes: it holds records alone
CONNECT_SECONDS = 10
CHECK_SECONDS = 10  # without a result, after which it is asked whether Ray still runs
MAX_STARTS = 3  # in a row, of actors that end before they get a scene
# A Ray of our own serves this machine alone: on its loopback address, with a token that others do not know.
OWN_RAY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token"}
TOKEN = "RAY_AUTH_TOKEN"
# Neither reports to Ray's authors nor warnings about GPUs that no actor asked for.
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
SILENT: dict[str, Any] = {"configure_logging": False, "log_to_driver": False, "logging_level": logging.CRITICAL}


def run_on_ray(
    scenes: Iterable[Scene], workers: int, threads: int, settings: Settings, address: str | None = None
) -> Generator[Outcome, None, None]:
    """Run scenes in actors; yields each scene's outcome as it is there.

    A scene whose actor was killed, or whose node left, is done again after the others, and is recorded as failed the
    second time. threads: of each actor, which asks Ray for as many CPUs.
    address: of a cluster, "auto" for the one that this machine belongs to; None to start Ray here, for as long as the
    iterator lives. A program that has called `ray.init` itself stays connected as it is.
    Raises InputError if Ray is not installed or not reached, the model cannot be opened, or actors end as they start.
    """
    with connected(address, workers * threads) as ray:
        yield from _Pool(ray, threads, settings).run(iter(scenes), workers)


class _Actor:
    """A process of Ray with one worker."""

    def __init__(self, settings: Settings, threads: int) -> None:
        self._worker = start_worker(settings, threads)

    def ready(self) -> None:
        """Return as soon as the process runs."""

    def run(self, scene: Scene) -> Outcome:
        return self._worker.run(scene)


class _Pool:
    """The actors, and what each is doing: a scene, or None while it starts."""

    def __init__(self, ray: ModuleType, threads: int, settings: Settings) -> None:
        self._ray, self._settings = ray, settings
        self._actor_class = ray.remote(_Actor).options(num_cpus=threads)
        self._arguments = settings, threads
        self._running: dict[Any, tuple[Any, Scene | None]] = {}  # by the reference to the result: the actor, the scene
        self._suspects: deque[Scene] = deque()
        self._once_killed: set[str] = set()
        self._starts = 0  # in a row that failed

    def run(self, scenes: Iterator[Scene], workers: int) -> Iterator[Outcome]:
        """Yield the outcome of each scene. An actor that has started gets the next scene, and the suspects last."""
        for _ in range(workers):
            self._start()
        while self._running:
            done = self._next_done()
            actor, scene = self._running.pop(done)
            try:
                outcome = self._ray.get(done)
            except self._ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, InputError):
                    raise InputError(str(error.cause)) from None
                raise error.cause from None
            except self._ray.exceptions.RayError as error:
                LOG.warning("an actor ended: %s", one_line(error))
                self._ray.kill(actor)
                yield from self._after_end(scene, error)
                self._start()
                continue
            self._starts = 0
            following = next(scenes, None) or (self._suspects.popleft() if self._suspects else None)
            if following is not None:
                self._running[actor.run.remote(following)] = actor, following
            elif not self._suspects and all(other is None for _, other in self._running.values()):
                self._running.clear()  # actors that never started are not waited for
            if scene is not None:
                yield outcome

    def _next_done(self) -> Any:
        """The reference to the next result. Raises InputError if no node of Ray is left that could make one."""
        while True:
            done, _ = self._ray.wait(list(self._running), num_returns=1, timeout=CHECK_SECONDS)
            if done:
                return done[0]
            # Ray itself waits for ever where its only node ends while an actor starts.
            if not any(node["Alive"] for node in self._ray.nodes()):
                raise InputError("--engine ray: Ray has ended; run the same command again, it does what is missing")

    def _start(self) -> None:
        """Start an actor; Ray may let it wait for CPUs, while the others do the work."""
        actor = self._actor_class.remote(*self._arguments)
        self._running[actor.ready.remote()] = actor, None

    def _after_end(self, scene: Scene | None, error: Exception) -> Iterator[Outcome]:
        """What follows from the end of an actor: its scene is done again, or has failed."""
        if scene is None:
            self._starts += 1
            if self._starts >= MAX_STARTS:
                reason = str(error).strip().splitlines()[-1]
                raise InputError(
                    f"Ray's actors end as they start: {reason}; each machine needs this version of idesplat, and "
                    "memory for its share of --workers"
                )
        elif scene.id in self._once_killed:
            yield record_killed(scene, self._settings)
        else:
            self._once_killed.add(scene.id)
            self._suspects.append(scene)


@contextmanager
def connected(address: str | None, cpus: int) -> Iterator[ModuleType]:
    """Ray, connected to a cluster or started here, for the block.

    Started here, it has so many CPUs, and listens on the loopback address alone, unless the program had imported Ray
    before. Raises InputError if Ray is not installed, does not start or is not reached.
    """
    os.environ.update(QUIET)
    if address is None:
        os.environ.update(OWN_RAY)
        os.environ.setdefault(TOKEN, secrets.token_hex(32))
    ray = _import_ray()
    if ray.is_initialized():
        yield ray
        return
    with _ray_folder() as folder:
        ending = signal.getsignal(signal.SIGTERM)
        try:
            if address is None:
                _start_here(ray, cpus, folder)
            else:
                _connect(ray, address)
            if ending is not None and threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, ending)  # Ray takes it, and would end the process without a word
            yield ray
        finally:
            ray.shutdown()


def _import_ray() -> ModuleType:
    try:
        import ray
        import ray.exceptions
    except ImportError:
        raise InputError(f"--engine ray: Ray is not installed; {INSTALL}") from None
    if not ray.is_initialized():
        logging.getLogger("ray").setLevel(logging.CRITICAL)  # what is wrong is in its exceptions
    module: ModuleType = ray
    return module


@contextmanager
def _ray_folder() -> Iterator[Path]:
    """A folder for Ray's logs and sockets, removed after the block. The names of sockets are short: about 100 bytes."""
    with scratch_folder(Path(os.environ.get("RAY_TMPDIR") or tempfile.gettempdir())) as folder:
        yield folder


def _start_here(ray: ModuleType, cpus: int, folder: Path) -> None:
    try:
        ray.init(
            address="local",
            num_cpus=cpus,
            num_gpus=0,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            _temp_dir=str(folder),
            _node_ip_address="127.0.0.1",
            **SILENT,
        )
    except Exception as error:
        raise InputError(
            f"--engine ray: Ray does not start: {one_line(error)}; --engine local does without it"
        ) from error


def _connect(ray: ModuleType, address: str) -> None:
    try:
        host, _, port = address.rpartition(":")
        if host and port.isdigit():  # Ray itself tries for minutes
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
        ray.init(address=address, **SILENT)
    except Exception as error:
        raise InputError(
            f"--address {address}: no Ray cluster is reached: {one_line(error)}; see `ray status`"
        ) from error
