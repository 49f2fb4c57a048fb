"""The worker processes of a service, each with the model open. One that crashes or is killed is started again."""

import asyncio
import json
import logging
import os
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ..errors import InputError
from ..system.limits import IMAGE_MEGAPIXELS
from .jobs import STOPPED, Job, Jobs, State
from .limits import TOKEN_VARIABLE, Limits
from .worker import Order, Setup, as_line

LOG = logging.getLogger(__name__)

MODULE = "idesplat.runtime.service.worker"
LONGEST_MESSAGE = 1 << 22  # bytes of a line from a worker
RESTART_S = 2.0  # between attempts to start a worker that ends as it starts
KILLED = -9  # the status of a process that SIGKILL has ended
MEMORY = "fewer or smaller images, fewer views or a smaller size may do"


class WorkerDied(Exception):
    """A worker process has ended. message: how."""


class Worker:
    """A worker process that has opened the model."""

    def __init__(self, process: Process) -> None:
        self.process = process

    @classmethod
    async def start(cls, setup: Setup) -> "Worker":
        """A worker that is ready. Raises InputError if the model cannot be opened, WorkerDied if the process ends."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", MODULE),
            stdin=PIPE,
            stdout=PIPE,
            stderr=DEVNULL,
            limit=LONGEST_MESSAGE,
            start_new_session=True,  # Ctrl-C in a terminal is for the service, which lets workers finish
            env=_environment() | {IMAGE_MEGAPIXELS.variable: str(setup.megapixels)},
        )
        worker = cls(process)
        try:
            await worker._send(as_line(setup))
            message = await worker._receive()
        except BaseException:
            await worker.end()
            raise
        if "failed" in message:
            await worker.end()
            raise InputError(message["failed"])
        return worker

    async def run(self, order: Order, report: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
        """Do one scene; the message `done` or `failed`. Raises WorkerDied."""
        await self._send(as_line(order))
        while "progress" in (message := await self._receive()):
            report(message["progress"])
        return message

    async def end(self) -> None:
        """Kill the process and those that it has started, and wait for its end."""
        with suppress(ProcessLookupError):
            if os.name == "nt":
                self.process.kill()
            else:
                os.killpg(self.process.pid, signal.SIGKILL)
        await self.process.wait()

    async def _send(self, line: bytes) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line)
            await self.process.stdin.drain()
        except ConnectionError:
            raise WorkerDied(await self._ending()) from None

    async def _receive(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        try:
            message = json.loads(await self.process.stdout.readline())
        except ValueError:  # no line, as the process has ended, or half a line
            raise WorkerDied(await self._ending()) from None
        return dict(message)

    async def _ending(self) -> str:
        await self.end()
        status = self.process.returncode or 0
        if status == KILLED:
            return f"its process was killed, out of memory perhaps; {MEMORY}"
        return f"its process crashed ({signal.Signals(-status).name if status < 0 else f'status {status}'})"


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != TOKEN_VARIABLE}


class Pool:
    """Takes jobs from the queue and has them done by worker processes."""

    def __init__(self, jobs: Jobs, setup: Setup, limits: Limits) -> None:
        self.jobs, self.setup, self.limits = jobs, setup, limits
        self.ready = 0
        self.restarts = 0
        self.failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._tasks = [asyncio.create_task(self._work()) for _ in range(jobs.workers)]

    async def stop(self) -> None:
        """End all workers."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.failure.cancel()

    async def _work(self) -> None:
        """Keep one worker, and start another one after it; the first error of opening the model ends the service."""
        opened = False
        while True:
            try:
                worker = await Worker.start(self.setup)
            except (InputError, WorkerDied) as error:
                LOG.warning("a worker process cannot start: %s", error)
                if not opened:
                    if not self.failure.done():
                        self.failure.set_exception(InputError(str(error)))
                    return
                await asyncio.sleep(RESTART_S)
                continue
            opened = True
            self.ready += 1
            try:
                while worker.process.returncode is None:
                    if (job := await self._next(worker)) is not None:
                        await self._run(worker, job)
            finally:
                self.ready -= 1
                await worker.end()
            self.restarts += 1

    async def _next(self, worker: Worker) -> Job | None:
        """The next job; None if the worker has ended first."""
        taken, ended = asyncio.ensure_future(self.jobs.next()), asyncio.ensure_future(worker.process.wait())
        try:
            await asyncio.wait({taken, ended}, return_when=asyncio.FIRST_COMPLETED)
            return taken.result() if taken.done() else None
        finally:
            taken.cancel()
            ended.cancel()

    async def _run(self, worker: Worker, job: Job) -> None:
        """Have a job done, unless it is cancelled or takes too long."""
        upload = job.upload
        cameras = None if upload.cameras is None else str(upload.cameras)
        order = Order(str(upload.folder), cameras, job.options, str(job.out), job.save_depth, job.render)
        work = asyncio.ensure_future(worker.run(order, job.report))
        cancelled = asyncio.ensure_future(job.cancelled.wait())
        try:
            await asyncio.wait({work, cancelled}, timeout=self.limits.seconds, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                self._finish(job, work)
                return
            await worker.end()
            if cancelled.done():
                self.jobs.finish(job, State.CANCELLED)
            else:
                limit = f"it took longer than {self.limits.seconds:g} s, the limit of this service"
                self.jobs.finish(job, State.FAILED, f"{limit}; {MEMORY}")
        except asyncio.CancelledError:
            self.jobs.finish(job, State.FAILED, STOPPED)
            raise
        finally:
            work.cancel()
            cancelled.cancel()
            await asyncio.gather(work, cancelled, return_exceptions=True)

    def _finish(self, job: Job, work: "asyncio.Future[dict[str, Any]]") -> None:
        try:
            message = work.result()
        except WorkerDied as error:
            self.jobs.finish(job, State.FAILED, str(error))
            return
        if "done" in message:
            job.result = message["done"]
            self.jobs.finish(job, State.DONE)
        else:
            if "details" in message:
                LOG.error("%s: %s", job.id, message["details"])
            self.jobs.finish(job, State.FAILED, message["failed"])
