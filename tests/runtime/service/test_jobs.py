"""The queue of a service, and the storage that it keeps bounded."""

import asyncio
import time

import pytest
from idesplat.runtime.service import jobs as module
from idesplat.runtime.service.jobs import Job, Jobs, State
from idesplat.runtime.service.limits import Limits, Refused
from idesplat.runtime.service.uploads import Upload
from running_service import complete


def add_job(jobs: Jobs, size: int = 10) -> Job:
    with jobs.reserve() as (name, folder):
        (folder / "images").mkdir()
        (folder / "images" / "a.png").write_bytes(bytes(size))
        job = Job(name, folder, Upload(folder / "images", None, [], {}), {}, True, False)
        jobs.add(job)
    return job


async def finish(jobs: Jobs, size: int) -> Job:
    job = await jobs.next()
    job.out.mkdir()
    (job.out / "scene.ply").write_bytes(bytes(size))
    jobs.finish(job, State.DONE)
    return job


@pytest.fixture
def no_pause(monkeypatch):
    monkeypatch.setattr(module, "OPENING_S", 0)


def test_jobs_run_in_their_order(tmp_path):
    async def run():
        jobs = Jobs(tmp_path, Limits(), 1)
        first, second, third = (add_job(jobs) for _ in range(3))
        jobs.cancel(second)
        assert [jobs.position(job) for job in (first, second, third)] == [0, None, 1]
        assert [await jobs.next(), await jobs.next()] == [first, third]
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(jobs.next(), 0.05)
        fourth = add_job(jobs)
        assert await asyncio.wait_for(jobs.next(), 5) == fourth

    complete(run())


def test_a_queue_that_is_full_takes_no_more(tmp_path):
    async def run():
        jobs = Jobs(tmp_path, Limits(queue=2), 1)
        add_job(jobs)
        with jobs.reserve(), pytest.raises(Refused) as refused, jobs.reserve():
            pass
        assert refused.value.status == 429
        assert refused.value.retry_after is not None

    complete(run())


def test_results_expire(tmp_path, no_pause):
    async def run():
        jobs = Jobs(tmp_path, Limits(keep_seconds=100), 1)
        old, new = add_job(jobs), add_job(jobs)
        for _ in range(2):
            await finish(jobs, 10)
        old.finished = time.time() - 101
        jobs.remove_expired()
        await asyncio.sleep(0.01)
        assert list(jobs) == [new]
        assert list(tmp_path.iterdir()) == [new.folder]

    complete(run())


def test_storage_that_is_full_makes_room_with_the_oldest_results(tmp_path, no_pause):
    async def run():
        jobs = Jobs(tmp_path, Limits(storage_bytes=1000), 1)
        made = []
        for _ in range(3):
            made.append(add_job(jobs))
            await finish(jobs, 450)
            made[-1].finished = len(made)
        assert jobs.stored == 1350
        running = add_job(jobs, 600)
        assert list(jobs) == [made[1], made[2], running]
        waiting = add_job(jobs, 400)
        assert list(jobs) == [running, waiting]
        with pytest.raises(Refused) as refused:  # what is not finished stays
            add_job(jobs)
        assert refused.value.status == 429

    complete(run())


def test_those_who_follow_a_job_see_its_end(tmp_path):
    async def run():
        jobs = Jobs(tmp_path, Limits(), 1)
        job, states = add_job(jobs), []

        async def follow():
            async for _ in job.changes(10):
                states.append((job.state, job.progress))

        following = [asyncio.create_task(follow()) for _ in range(2)]
        await asyncio.sleep(0)
        assert await jobs.next() == job
        await asyncio.sleep(0)
        for done in range(3):
            job.report({"description": "working", "done": done, "total": 3})
        await asyncio.sleep(0.01)
        jobs.finish(job, State.FAILED, "for a reason")
        await asyncio.wait_for(asyncio.gather(*following), 5)
        assert states[0] == states[1] == (State.QUEUED, None)
        assert states[-1] == states[-2] == (State.FAILED, None)
        assert (State.RUNNING, {"description": "working", "done": 2, "total": 3}) in states

    complete(run())
