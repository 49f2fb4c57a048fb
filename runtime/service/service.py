"""The service without HTTP: jobs, workers, conversions and what is counted, from start to stop."""

import asyncio
import logging
import sys
import time
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from starlette.requests import Request

from ..batch.scenes import parse_flag
from ..errors import error_context
from ..inference.model_files import ModelFiles
from ..reconstruction.quality import default_quality
from ..splats.io import FORMATS
from ..system.output_names import POINT_ENDINGS
from .fields import parse_options
from .jobs import MAX_WAIT_S, Job, Jobs
from .limits import Limits, Refused
from .metrics import Metrics
from .pool import Pool
from .uploads import receive_scene
from .worker import SCENE, Setup

LOG = logging.getLogger(__name__)

ENDINGS = (*FORMATS, *POINT_ENDINGS)  # of `scene`
SWEEP_S = 1.0
POLL_S = 0.1
LINGER_S = 2.0  # that clients have, after the last job of a service that stops, to fetch its results
CONVERSIONS = 1  # at a time
MAX_CONVERSIONS_WAITING = 16
CONVERT_S = 300.0
SAVE_DEPTH, RENDER = "save_depth", "render"


@dataclass(frozen=True)
class Settings:
    """What a service is started with. token: None for none."""

    model: ModelFiles
    setup: Setup
    host: str
    port: int
    workers: int = 1
    token: str | None = None
    limits: Limits = field(default_factory=Limits)


class Service:
    """A running service. folder: for the jobs' files."""

    def __init__(self, settings: Settings, folder: Path) -> None:
        self.settings = settings
        self.jobs = Jobs(folder, settings.limits, settings.workers)
        self.pool = Pool(self.jobs, settings.setup, settings.limits)
        self.metrics = Metrics(self.jobs, self.pool)
        self._converting = asyncio.Semaphore(CONVERSIONS)
        self._waiting = 0

    @classmethod
    @asynccontextmanager
    async def running(cls, settings: Settings, folder: Path) -> AsyncIterator["Service"]:
        """A service for as long as the block runs."""
        service = cls(settings, folder)
        sweeping = asyncio.create_task(service._sweep())
        try:
            yield service
        finally:
            sweeping.cancel()
            await asyncio.gather(sweeping, return_exceptions=True)
            await service.pool.stop()

    @property
    def is_ready(self) -> bool:
        """Whether scenes are taken, and a worker is there for them."""
        return self.pool.ready > 0 and not self.jobs.draining

    async def submit(self, request: Request) -> Job:
        """Receive a scene and queue it. Raises Refused, InputError and HTTPException."""
        with self.jobs.reserve() as (name, folder):
            try:
                upload = await receive_scene(request, folder, self.settings.limits)
            except OSError as error:
                LOG.error("an upload cannot be stored: %s", error)
                raise Refused(507, "the service cannot store the upload; try again later", MAX_WAIT_S) from None
            texts = dict(upload.texts)
            depth, render = (_flag(texts, option, default) for option, default in ((SAVE_DEPTH, True), (RENDER, False)))
            parse_options(texts, default_quality(self.settings.model.path), upload.images, self.settings.limits)
            given = {option: text for option, text in texts.items() if text}
            job = Job(name, folder, upload, given, depth, render)
            self.jobs.add(job)
        LOG.info("%s: queued, %d images", job.id, len(upload.images))
        return job

    async def scene_file(self, job: Job, ending: str) -> Path:
        """The splats in a format, converted when first asked for. Raises Refused."""
        if ending not in ENDINGS:
            raise Refused(404, f"scene{ending}: no such format; expected one of {', '.join(ENDINGS)}")
        path = job.out / f"scene{ending}"
        if not path.exists() and (job.out / SCENE).exists():
            if self._waiting >= MAX_CONVERSIONS_WAITING:
                raise Refused(429, "too many conversions wait; try again later", self.jobs.retry_after())
            self._waiting += 1
            try:
                async with self._converting:
                    if not path.exists():
                        await _convert(job.out / SCENE, path)
                        job.size += path.stat().st_size
            finally:
                self._waiting -= 1
        return path

    async def stop(self) -> None:
        """Take no more scenes, and let those that run finish within `stop_seconds`."""
        running = bool(self.jobs.running)
        self.jobs.drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(self.settings.limits.stop_seconds):
                while self.jobs.running or self.jobs.uploading:
                    await asyncio.sleep(POLL_S)
        await self.pool.stop()
        if running:
            await asyncio.sleep(LINGER_S)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            self.jobs.remove_expired()


def _flag(texts: dict[str, str], name: str, default: bool) -> bool:
    """Take a field that says whether something is written, too. Raises InputError."""
    text = texts.pop(name, "").lower()
    with error_context(f"{name} {text[:40]!r}"):
        return parse_flag(text) if text else default


async def _convert(source: Path, target: Path) -> None:
    """Convert splats with `idesplat convert`, in a process of its own."""
    started = time.monotonic()
    command = (sys.executable, "-P", "-m", "idesplat", "convert", str(source), str(target))
    process = await asyncio.create_subprocess_exec(*command, stdin=DEVNULL, stdout=DEVNULL, stderr=PIPE)
    try:
        async with asyncio.timeout(CONVERT_S):
            _, errors = await process.communicate()
    except BaseException as error:
        with suppress(ProcessLookupError):
            process.kill()
        if isinstance(error, TimeoutError):
            raise Refused(409, f"{target.name}: the conversion took longer than {CONVERT_S:g} s") from None
        raise
    if process.returncode:
        line = errors.decode(errors="replace").strip().splitlines()[-1:] or [f"status {process.returncode}"]
        message = line[0].removeprefix("error: ").replace(f"{source.parent}/", "")
        raise Refused(409, f"{target.name}: cannot be made: {message}")
    LOG.info("%s in %.2f s", target, time.monotonic() - started)
