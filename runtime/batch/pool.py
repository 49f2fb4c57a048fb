"""The local engine: a pool of processes, which is opened again when one of them is killed."""

import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing.connection import Connection

from ..errors import InputError
from .scenes import Scene
from .worker import Outcome, Settings, Worker, record_killed, start_worker

LOG = logging.getLogger(__name__)

STDERR = 2

_WORKERS: list[Worker] = []  # one in each process


def run_in_pool(
    scenes: Iterable[Scene], workers: int, threads: int, settings: Settings
) -> Generator[Outcome, None, None]:
    """Run scenes in processes; yields each scene's outcome as it is there.

    The scenes that were under way when a worker was killed are done again, one at a time, and the one whose worker is
    killed again is recorded as failed. The processes end with the iterator, and with this process however it ends.
    threads: of each worker.
    Raises InputError if the model cannot be opened, or processes end before they get a scene.
    """
    waiting, suspects = _Waiting(scenes), deque[Scene]()
    while waiting or suspects:
        with _processes(workers, threads, settings) as pool:
            try:
                yield from _run_alone(pool, settings, suspects)
                yield from _run_together(pool, waiting, suspects, workers)
            except BrokenProcessPool:
                LOG.warning("a worker process was killed; starting it again")


class _Waiting:
    """Scenes that no process has got yet; the next is read when it is asked for."""

    def __init__(self, scenes: Iterable[Scene]) -> None:
        self._scenes = iter(scenes)
        self._next = deque(islice(self._scenes, 1))

    def __bool__(self) -> bool:
        return bool(self._next)

    def peek(self) -> Scene:
        return self._next[0]

    def pop(self) -> None:
        self._next.clear()
        self._next.extend(islice(self._scenes, 1))


@contextmanager
def _processes(workers: int, threads: int, settings: Settings) -> Iterator[ProcessPoolExecutor]:
    """A pool that has been seen to start. Its processes end when the block or this process ends."""
    # At the end of the pipe, which comes when the other side is closed or its process has ended, a worker exits.
    reader, writer = multiprocessing.Pipe(duplex=False)
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _start, (settings, threads, reader))
    try:
        try:
            pool.submit(os.getpid).result()
        except BrokenProcessPool:
            raise InputError("worker processes end as they start; use fewer --workers, or free memory") from None
        yield pool
    finally:
        writer.close()
        pool.shutdown(cancel_futures=True)
        reader.close()


def _run_alone(pool: ProcessPoolExecutor, settings: Settings, suspects: deque[Scene]) -> Iterator[Outcome]:
    """Run scenes one at a time. Raises BrokenProcessPool after a scene whose worker was killed."""
    while suspects:
        scene = suspects.popleft()
        try:
            outcome = pool.submit(_run, scene).result()
        except BrokenProcessPool:
            yield record_killed(scene, settings)
            raise
        yield outcome


def _run_together(
    pool: ProcessPoolExecutor, waiting: _Waiting, suspects: deque[Scene], workers: int
) -> Iterator[Outcome]:
    """Run as many scenes at a time as there are workers; those under way when one is killed become suspects."""
    running: dict[Future[Outcome], Scene] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running[pool.submit(_run, waiting.peek())] = waiting.peek()
                waiting.pop()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                outcome = future.result()
                del running[future]
                yield outcome
    except BrokenProcessPool:
        suspects.extend(running.values())
        raise


def _start(settings: Settings, threads: int, alive: Connection) -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first ends the others
    os.dup2(os.open(os.devnull, os.O_WRONLY), STDERR)  # native libraries' warnings; errors are in the records
    threading.Thread(target=_exit_at_end, args=(alive,), daemon=True).start()
    _WORKERS[:] = [start_worker(settings, threads)]


def _exit_at_end(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _run(scene: Scene) -> Outcome:
    return _WORKERS[0].run(scene)
