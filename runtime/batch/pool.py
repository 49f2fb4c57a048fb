"""The local engine: a pool of processes, which is opened again when one of them is killed."""

import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import cv2

from ..errors import InputError
from ..system.outputs import outputs
from ..system.threads import limit_threads
from .records import RECORD, Status, read_record, write_record
from .scenes import Scene
from .worker import Outcome, Settings, Worker

LOG = logging.getLogger(__name__)

KILLED = "its worker process was killed twice, out of memory perhaps; use fewer workers, or fewer or smaller images"
STDERR = 2

_WORKERS: list[Worker] = []  # one in each process


def run_in_pool(
    scenes: Sequence[Scene], out: Path, workers: int, threads: int, settings: Settings
) -> Generator[Outcome, None, None]:
    """Run scenes in processes; yields each scene's outcome as it is there.

    The scenes that were under way when a worker was killed are done again, one at a time, and the one whose worker is
    killed again is recorded as failed. The processes end with the iterator, and with this process however it ends.
    threads: of each worker.
    Raises InputError if the model cannot be opened, or processes end before they get a scene.
    """
    waiting, suspects = deque(scenes), deque[Scene]()
    while waiting or suspects:
        with _processes(workers, threads, settings) as pool:
            try:
                yield from _run_alone(pool, out, suspects)
                yield from _run_together(pool, out, waiting, suspects, workers)
            except BrokenProcessPool:
                LOG.warning("a worker process was killed; starting it again")


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


def _run_alone(pool: ProcessPoolExecutor, out: Path, suspects: deque[Scene]) -> Iterator[Outcome]:
    """Run scenes one at a time. Raises BrokenProcessPool after a scene whose worker was killed."""
    while suspects:
        scene = suspects.popleft()
        try:
            outcome = pool.submit(_run, scene, out / scene.id).result()
        except BrokenProcessPool:
            yield _record_killed(scene, out / scene.id)
            raise
        yield outcome


def _run_together(
    pool: ProcessPoolExecutor, out: Path, waiting: deque[Scene], suspects: deque[Scene], workers: int
) -> Iterator[Outcome]:
    """Run as many scenes at a time as there are workers; those under way when one is killed become suspects."""
    running: dict[Future[Outcome], Scene] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running[pool.submit(_run, waiting[0], out / waiting[0].id)] = waiting[0]
                waiting.popleft()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                outcome = future.result()
                del running[future]
                yield outcome
    except BrokenProcessPool:
        suspects.extend(running.values())
        raise


def _record_killed(scene: Scene, folder: Path) -> Outcome:
    """The failure of a scene whose worker was killed."""
    before = read_record(folder) or {}
    record = {"id": scene.id, "status": Status.FAILED, "error": KILLED, "hash": before.get("hash"), "seconds": None}
    try:
        outputs().writes("", [folder / RECORD], known=True)
        write_record(folder, record)
    except InputError as error:
        LOG.warning("%s", error)
    return Outcome(record, True)


def _start(settings: Settings, threads: int, alive: Connection) -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first ends the others
    os.dup2(os.open(os.devnull, os.O_WRONLY), STDERR)  # native libraries' warnings; errors are in the records
    threading.Thread(target=_exit_at_end, args=(alive,), daemon=True).start()
    limit_threads(threads)
    cv2.setNumThreads(threads)
    _WORKERS[:] = [Worker(settings)]


def _exit_at_end(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _run(scene: Scene, folder: Path) -> Outcome:
    return _WORKERS[0].run(scene, folder)
