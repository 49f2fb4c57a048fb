"""Load on a real `idesplat serve`: many clients at once, each of which checks that its result is of its own images.

    python -P -m idesplat.tools.benchmark.service_load --clients 50 --seconds 300

A client sends two images of noise whose cameras stand at a place in the world that no other request has. The images'
names and the place come back in the result, so results that are mixed up are found. Answers of 429 are waited out as
Retry-After asks. Memory is read from /proc, so this runs on Linux.
"""

import asyncio
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Annotated

import httpx
import numpy as np
import typer
from PIL import Image

from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError
from ...runtime.splats.io import read_splats

SIDE = 64  # pixels of the images
FOCAL = 60.0  # pixels
BASELINE = 0.2
NEAR, FAR = 1.0, 20.0
SPACING = 100.0  # between the places of requests: more than FAR, so that results do not overlap
FORM = {"quality": "fast", "size": f"{SIDE}x{SIDE}", "near": str(NEAR), "far": str(FAR), "save_depth": "false"}
SAMPLE_S = 1.0
REQUEST_S = 120.0
POLL_S = 0.2
MAX_SHOWN = 20  # faults
STARTED = "serving at "


@dataclass
class Tally:
    """What has become of the requests. problems: in words, each a fault of the service."""

    accepted: int = 0
    verified: int = 0
    refused: int = 0
    answers: Counter[int] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    waits: list[float] = field(default_factory=list)
    memory: list[tuple[int, int]] = field(default_factory=list)  # bytes of the service, and of its workers


def load(
    clients: Annotated[int, typer.Option(help="At once.", min=1)] = 50,
    seconds: Annotated[float, typer.Option(help="For which new scenes are sent.", min=1)] = 300,
    workers: Annotated[int, typer.Option(help="Of the service.", min=1)] = 1,
    queue: Annotated[int, typer.Option(help="Of the service.", min=1)] = 16,
) -> None:
    """Start a service, send it scenes, check every result, and print what happened; status 1 for any fault."""
    with tempfile.TemporaryDirectory() as storage, _service(Path(storage), workers, queue) as (process, address, token):
        tally = asyncio.run(_load(address, token, process.pid, clients, seconds))
    _tell(tally, clients, seconds)
    if tally.problems:
        raise typer.Exit(1)


@contextmanager
def _service(storage: Path, workers: int, queue: int) -> Iterator[tuple["subprocess.Popen[str]", str, str]]:
    """A service in a process of its own: the process, its address and its token."""
    token = secrets.token_hex()
    options = ["--port", "0", "--threads", "1", "--workers", str(workers), "--max-queue", str(queue), "--keep", "20"]
    command = [sys.executable, "-P", "-m", "idesplat", "serve", *options, "--storage", str(storage)]
    environment = os.environ | {"IDESPLAT_TOKEN": token}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line.startswith(STARTED):
                raise InputError("the service has not started")
            yield process, line.removeprefix(STARTED).split()[0], token
        finally:
            process.terminate()


async def _load(address: str, token: str, process: int, clients: int, seconds: float) -> Tally:
    tally = Tally()
    ends = time.monotonic() + seconds
    limits = httpx.Limits(max_connections=None)
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(
        base_url=address, headers=headers, timeout=REQUEST_S, limits=limits, trust_env=False
    ) as client:
        while (await client.get("/ready")).status_code != httpx.codes.OK:
            await asyncio.sleep(POLL_S)
        sampling = asyncio.create_task(_sample_memory(process, tally))
        await asyncio.gather(*(_client(client, number, ends, tally) for number in range(clients)))
        sampling.cancel()
    return tally


async def _client(client: httpx.AsyncClient, number: int, ends: float, tally: Tally) -> None:
    """One client: a scene after the other."""
    count = 0
    while time.monotonic() < ends:
        name = f"client-{number:03d}-{count:05d}"
        place = np.array([number, count, 0]) * SPACING
        try:
            answer = await client.post("/v1/scenes", files=_form(name, place), data=FORM)
            tally.answers[answer.status_code] += 1
            if answer.status_code == httpx.codes.TOO_MANY_REQUESTS:
                tally.refused += 1
                await asyncio.sleep(int(answer.headers["Retry-After"]))
                continue
            answer.raise_for_status()
            tally.accepted += 1
            count += 1
            started = time.monotonic()
            await _check(client, answer.json()["url"], name, place)
            tally.waits.append(time.monotonic() - started)
            tally.verified += 1
        except (httpx.HTTPError, AssertionError) as error:
            tally.problems.append(f"{name}: {type(error).__name__} {error}")


def _form(name: str, place: np.ndarray) -> list[tuple[str, tuple[str, bytes]]]:
    """Two images of noise seen from `place` [3], and their cameras."""
    noise = np.random.default_rng(list(name.encode())).integers(0, 256, (SIDE, 2 * SIDE, 3), np.uint8)
    frames, files = [], []
    for index, shift in enumerate((0, 2)):  # pixels
        buffer = BytesIO()
        Image.fromarray(np.ascontiguousarray(noise[:, shift : shift + SIDE])).save(buffer, "PNG")
        files.append(("images", (f"{name}-{index}.png", buffer.getvalue())))
        pose = np.eye(4)
        pose[:3, 3] = place + np.array([index * BASELINE, 0, 0])
        frames.append({"file_path": f"{name}-{index}.png", "transform_matrix": pose.tolist()})
    cameras = {"w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIDE / 2, "cy": SIDE / 2, "frames": frames}
    return [*files, ("cameras", ("transforms.json", json.dumps(cameras).encode()))]


async def _check(client: httpx.AsyncClient, url: str, name: str, place: np.ndarray) -> None:
    """Follow a scene to its end, and compare its result with what was sent; raises AssertionError."""
    state: dict[str, object] = {}
    async with client.stream("GET", f"{url}/events") as answer:
        async for line in answer.aiter_lines():
            if line.startswith("data: "):
                state = json.loads(line.removeprefix("data: "))
    assert state["state"] == "done", f"{state['state']}: {state['error']}"
    assert state["views"] == [f"{name}-{index}.png" for index in range(2)], state["views"]
    content = (await client.get(f"{url}/scene.ply")).raise_for_status().content
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.ply")
        path.write_bytes(content)
        means = read_splats(path).means
    distance = np.abs(means - place).max()
    assert distance < SPACING, f"the result lies {distance:.0f} from its cameras"


async def _sample_memory(process: int, tally: Tally) -> None:
    while True:
        workers = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        tally.memory.append((_resident(str(process)), sum(map(_resident, workers))))
        await asyncio.sleep(SAMPLE_S)


def _resident(process: str) -> int:
    """Bytes of memory of a process; 0 for one that has ended."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) * 1024
    except (OSError, IndexError):
        return 0


def _tell(tally: Tally, clients: int, seconds: float) -> None:
    waits = np.percentile(tally.waits or [0], (50, 95, 100))
    say(
        f"{clients} clients, {seconds:g} s: {tally.accepted} scenes accepted, {tally.verified} done and of their own "
        f"images, {len(tally.problems)} faults; {tally.refused} answers 429",
        "answers to POST: " + ", ".join(f"{status}: {count}" for status, count in sorted(tally.answers.items())),
        "seconds from acceptance to result: median {:.1f}, 95 % {:.1f}, longest {:.1f}".format(*waits),
    )
    for what, values in zip(("service", "workers"), zip(*tally.memory, strict=True), strict=True):
        tenth = max(1, len(values) // 10)
        shares = [np.median(values[at : at + tenth]) / 1e6 for at in (tenth, len(values) // 2, len(values) - tenth)]
        say(f"memory of the {what}, MB: " + " -> ".join(f"{share:.0f}" for share in shares) + " (start, middle, end)")
    if tally.problems:
        say(*tally.problems[:MAX_SHOWN])


def main() -> None:
    """Run the command."""
    run(load)


if __name__ == "__main__":
    main()
