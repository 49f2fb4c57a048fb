"""Jobs and their queue. Everything here runs in the service's event loop, so nothing is locked."""

import asyncio
import logging
import os
import secrets
import shutil
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from .limits import Limits, Refused
from .uploads import Upload

LOG = logging.getLogger(__name__)

ID_BYTES = 16  # that nobody guesses
MAX_KEPT = 1000  # finished jobs
OPENING_S = 2.0  # between the end of a job and the removal of its files: answers that are being prepared open them
MAX_WAIT_S = 60  # of Retry-After
USUAL_S = 10.0  # of a job, before any has been done
SMOOTHING = 0.2  # weight of the last job in their mean time
STOPPED = "the service was stopped; send the scene again"  # the error of jobs that it ended


class State(StrEnum):
    """What has become of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


FINISHED = (State.DONE, State.FAILED, State.CANCELLED)


@dataclass(eq=False)
class Job:
    """One scene. folder: of its files, the results in `out` of it. error: one line, of a failed job.

    progress: what is being done, items done and their number. result: what the worker has said about the result.
    """

    id: str
    folder: Path
    upload: Upload
    options: Mapping[str, str]
    save_depth: bool
    render: bool
    state: State = State.QUEUED
    error: str | None = None
    progress: dict[str, Any] | None = None
    result: dict[str, Any] = field(default_factory=dict)
    created: float = field(default_factory=time.time)
    started: float | None = None
    finished: float | None = None
    size: int = 0  # bytes of its files
    cancelled: asyncio.Event = field(default_factory=asyncio.Event)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def out(self) -> Path:
        """The folder of the results."""
        return self.folder / "out"

    @property
    def is_finished(self) -> bool:
        """Whether nothing about it changes any more."""
        return self.state in FINISHED

    def files(self) -> list[str]:
        """The results by their paths in `out`, with `/`."""
        if self.state is not State.DONE:
            return []
        return sorted(path.relative_to(self.out).as_posix() for path in files_in(self.out))

    def report(self, progress: dict[str, Any]) -> None:
        """Take note of progress."""
        self.progress = progress
        self.tell()

    def tell(self) -> None:
        """Wake those who follow the job."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def changes(self, seconds: float) -> AsyncIterator[None]:
        """Yield now, after each change, and after so many seconds without one; ends with the job.

        Changes that come faster than they are taken are one.
        """
        while True:
            changed = self._changed
            yield
            if self.is_finished:
                return
            try:
                async with asyncio.timeout(seconds):
                    await changed.wait()
            except TimeoutError:
                continue


class Jobs:
    """All jobs of a service. folder: for their files. workers: how many run at a time."""

    def __init__(self, folder: Path, limits: Limits, workers: int) -> None:
        self.folder, self.limits, self.workers = folder, limits, workers
        self.draining = False
        self.uploading = 0
        self.on_finish: Callable[[Job], None] = lambda job: None
        self._jobs: dict[str, Job] = {}
        self._queue: deque[Job] = deque()
        self._added = asyncio.Semaphore(0)
        self._mean_s = USUAL_S

    def __iter__(self) -> Iterator[Job]:
        return iter(self._jobs.values())

    @property
    def waiting(self) -> int:
        """How many jobs are queued."""
        return len(self._queue)

    @property
    def running(self) -> list[Job]:
        """The jobs that run."""
        return [job for job in self if job.state is State.RUNNING]

    @property
    def stored(self) -> int:
        """Bytes of all files."""
        return sum(job.size for job in self)

    def retry_after(self) -> int:
        """Seconds after which there is likely to be room in the queue."""
        return int(min(MAX_WAIT_S, max(1.0, self._mean_s * max(1, self.waiting) / self.workers / 2)))

    @contextmanager
    def reserve(self) -> Iterator[tuple[str, Path]]:
        """A place in the queue, as the id and the folder of a job to be; the folder is removed if the block fails.

        Raises Refused where the service stops, the queue is full, or the files of unfinished jobs take all storage.
        """
        self._check_open()
        if self.waiting + self.uploading >= self.limits.queue:
            raise Refused(429, "too many scenes wait; try again later", self.retry_after())
        if not self._make_room():
            raise Refused(429, "the storage is full; try again later, or delete scenes", self.retry_after())
        name = secrets.token_hex(ID_BYTES)
        folder = self.folder / name
        self.uploading += 1
        try:
            folder.mkdir()
            yield name, folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self.uploading -= 1

    def add(self, job: Job) -> None:
        """Queue a job. Raises Refused where the service has begun to stop."""
        self._check_open()
        job.size = folder_size(job.folder)
        self._jobs[job.id] = job
        self._queue.append(job)
        self._added.release()

    async def next(self) -> Job:
        """The first job in the queue, running from now on."""
        while True:
            await self._added.acquire()
            if self._queue:  # it may have been cancelled
                job = self._queue.popleft()
                job.state, job.started = State.RUNNING, time.time()
                self._tell_queue()
                job.tell()
                return job

    def get(self, name: str) -> Job:
        """The job with an id. Raises Refused if there is none."""
        if name not in self._jobs:
            raise Refused(404, "no such scene; it may have expired")
        return self._jobs[name]

    def position(self, job: Job) -> int | None:
        """How many jobs are before it in the queue; None if it is not in it."""
        return self._queue.index(job) if job in self._queue else None

    def finish(self, job: Job, state: State, error: str | None = None) -> None:
        """Note the end of a job, and remove what it was made from."""
        job.state, job.error, job.finished, job.progress = state, error, time.time(), None
        if job.started is not None and state is State.DONE:
            self._mean_s += SMOOTHING * (job.finished - job.started - self._mean_s)
        for path in job.folder.iterdir() if job.folder.is_dir() else ():
            if path != job.out or state is not State.DONE:
                shutil.rmtree(path, ignore_errors=True)
        job.size = folder_size(job.folder)
        job.tell()
        self.on_finish(job)
        LOG.info("%s: %s%s", job.id, state, f": {error}" if error else "")

    def cancel(self, job: Job) -> None:
        """Take a job out of the queue, end it where it runs, or remove its results."""
        if job in self._queue:
            self._queue.remove(job)
            self.finish(job, State.CANCELLED)
            self._tell_queue()
        elif job.state is State.RUNNING:
            job.cancelled.set()
        else:
            self._remove(job)

    def drain(self) -> None:
        """Take no more jobs, and answer for those in the queue."""
        self.draining = True
        while self._queue:
            self.finish(self._queue.popleft(), State.FAILED, STOPPED)

    def remove_expired(self) -> None:
        """Remove the finished jobs that are older than `keep_seconds`, or more than `MAX_KEPT`."""
        finished = self._finished()
        oldest = time.time() - self.limits.keep_seconds
        surplus = max(0, len(finished) - MAX_KEPT)
        for index, job in enumerate(finished):
            if index < surplus or (job.finished or 0) < oldest:
                self._remove(job)

    def _check_open(self) -> None:
        """Raise Refused where the service has begun to stop."""
        if self.draining:
            raise Refused(503, "the service stops; try again later", self.retry_after())

    def _make_room(self) -> bool:
        """Remove the oldest results where the storage is full; whether there is room then."""
        for job in self._finished():
            if self.stored < self.limits.storage_bytes:
                break
            self._remove(job)
        return self.stored < self.limits.storage_bytes

    def _finished(self) -> list[Job]:
        return sorted((job for job in self if job.is_finished), key=lambda job: job.finished or 0)

    def _remove(self, job: Job) -> None:
        del self._jobs[job.id]
        asyncio.get_running_loop().call_later(OPENING_S, lambda: shutil.rmtree(job.folder, ignore_errors=True))

    def _tell_queue(self) -> None:
        for job in self._queue:
            job.tell()


def folder_size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    size = 0
    for path in files_in(folder):
        with suppress(OSError):  # it has been removed meanwhile
            size += path.stat().st_size
    return size


def files_in(folder: Path) -> list[Path]:
    """The files in a folder and those below, without hidden ones, which are those that a conversion works on."""
    found = []
    for place, folders, names in os.walk(folder):  # `rglob` fails where a folder is removed meanwhile
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(place, name) for name in names if not name.startswith(".")]
    return found
