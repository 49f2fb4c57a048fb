"""A real service in a process of its own, on the loopback address."""

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

START_S = 120
ENDED = ("done", "failed", "cancelled")


@dataclass
class RunningService:
    """url: of the service. storage: the folder of its files."""

    url: str
    process: subprocess.Popen[str]
    storage: Path

    def client(self, token: str | None = None) -> httpx.Client:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=60, trust_env=False)

    def jobs(self) -> set[str]:
        """The folders of jobs."""
        (folder,) = self.storage.iterdir()
        return set(os.listdir(folder))


@contextmanager
def running_service(storage: Path, *options: object, token: str | None = None) -> Iterator[RunningService]:
    """A service with these options, once it is ready."""
    command = [sys.executable, "-P", "-m", "idesplat", "serve", "--port", "0", "--storage", str(storage)]
    environment = os.environ | ({"IDESPLAT_TOKEN": token} if token else {}) | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [*command, "--threads", "1", *map(str, options)], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        line = process.stdout.readline()
        service = RunningService(line.split("serving at ")[1].split()[0], process, storage)
        with service.client() as client:
            ends = time.monotonic() + START_S
            while client.get("/ready").status_code != 200:
                assert process.poll() is None
                assert time.monotonic() < ends
                time.sleep(0.05)
        yield service
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def wait_for(client: httpx.Client, scene: str, states: tuple[str, ...] = ENDED) -> dict:
    """The scene when it is in one of these states."""
    for _ in range(2400):
        found = client.get(f"/v1/scenes/{scene}").json()
        if found["state"] in states:
            return found
        time.sleep(0.05)
    raise AssertionError(found)


def complete(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine in a thread: in this one, the browser of other tests has an event loop."""
    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, coroutine).result()
