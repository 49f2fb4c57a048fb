"""Worker processes of the service that take too long, or crash."""

import asyncio
import os
import shutil
import signal
import subprocess

import pytest
from idesplat.runtime.service.jobs import Job, Jobs, State
from idesplat.runtime.service.limits import Limits
from idesplat.runtime.service.pool import MODULE, Pool
from idesplat.runtime.service.uploads import Upload
from idesplat.runtime.service.worker import Setup
from running_service import complete
from tiny_model import write_model

pytestmark = pytest.mark.slow

ENDLESS = {"quality": "fast", "size": "64x96", "views": "3", "refine": "500s"}


def add_job(jobs, scene):
    with jobs.reserve() as (name, folder):
        copied = shutil.copytree(scene, folder / "scene")
        job = Job(name, folder, Upload(copied, None, [], {}), ENDLESS, False, False)
        jobs.add(job)
    return job


async def ended(job):
    async for _ in job.changes(60):
        pass
    return job


@pytest.mark.posix
def test_a_worker_is_replaced_after_a_job_that_takes_too_long_or_crashes(scene, tmp_path):
    model = write_model(tmp_path / "tiny.onnx")

    async def run():
        limits = Limits(seconds=2)
        (tmp_path / "jobs").mkdir()
        jobs = Jobs(tmp_path / "jobs", limits, 1)
        pool = Pool(jobs, Setup(str(model), "CPU", 1, None, {}, 64, None), limits)
        job = await asyncio.wait_for(ended(add_job(jobs, scene)), 120)
        assert job.state is State.FAILED
        assert "longer than 2 s" in job.error
        assert list(job.folder.iterdir()) == []
        crashing = add_job(jobs, scene)
        while crashing.progress is None:
            await asyncio.sleep(0.01)
        command = ["pgrep", "-P", str(os.getpid()), "-f", MODULE]
        os.kill(int(subprocess.run(command, capture_output=True, check=True).stdout), signal.SIGSEGV)
        await asyncio.wait_for(ended(crashing), 60)
        assert crashing.error == "its process crashed (SIGSEGV)"
        await pool.stop()
        assert pool.restarts >= 1

    complete(run())
