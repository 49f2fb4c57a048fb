"""Killing the workers of a batch at the moment at which they begin a scene."""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

POLL_S = 0.001


@contextmanager
def killing_workers(out: Path, workers: Callable[[], Iterable[int]]) -> Iterator[list[str]]:
    """For the block, kill the workers when they begin b for the first time, and whenever they begin c.

    out: of the batch. workers: finds their processes. Gives the scenes in which they were killed, as it happens.
    """
    killed: list[str] = []
    ended = threading.Event()

    def kill() -> None:
        seen = set()
        while not ended.wait(POLL_S):
            for name in ("c",) if "b" in killed else ("b", "c"):
                record = out / name / "record.json"
                try:
                    begun = record.stat().st_mtime_ns
                    if begun in seen or json.loads(record.read_text())["status"] != "started":
                        continue
                except FileNotFoundError:
                    continue
                seen.add(begun)
                killed.append(name)
                for process in workers():
                    os.kill(process, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        ended.set()
        killer.join()
