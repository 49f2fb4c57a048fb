"""Data-parallel training on one machine: processes share the scenes of a step and sum their gradients."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import nn

from ...runtime.errors import InputError
from ...runtime.system.files import atomic_write, scratch_folder
from ..processes import safe_path

# Gloo looks up the host's name, which need not resolve; all processes are on this machine.
INTERFACE_VARIABLE = "GLOO_SOCKET_IFNAME"
LOOPBACK = {"linux": "lo", "darwin": "lo0"}
# Files with the messages of processes that ended with an InputError, by rank.
ERROR_FILES = "error-*"


class ProcessEnded(InputError):
    """Another process of the group has ended."""


class ProcessGroup:
    """The processes of a run, of which rank 0 logs, validates and saves. A group of one exchanges nothing."""

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def is_main(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0

    def shard(self, batch: int) -> range:
        """The places of a batch whose scenes this process computes."""
        return range(self.rank, batch, self.size)

    def all_reduce_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Sum every gradient over all processes; raises ProcessEnded if one of them has ended.

        A parameter that has no gradient in any process keeps none.
        """
        if self.size == 1:
            return
        trained = [p for p in parameters if p.requires_grad]
        found = torch.tensor([float(p.grad is not None) for p in trained], device=trained[0].device)
        parts = [torch.zeros_like(p).flatten() if p.grad is None else p.grad.flatten() for p in trained]
        flat = torch.cat([found, *parts]).cpu()  # gloo exchanges what is in the memory of the CPU
        with _peer_errors():
            dist.all_reduce(flat)
        found, *parts = flat.split([len(trained), *(p.numel() for p in trained)])
        for p, count, part in zip(trained, found.tolist(), parts, strict=True):
            p.grad = part.view_as(p).to(p.device) if count else None

    def gather(self, entries: list[dict[str, float]]) -> list[dict[str, float]]:
        """The entries of all processes, in the order of ranks; raises ProcessEnded if one of them has ended."""
        if self.size == 1:
            return entries
        gathered: list[Any] = [None] * self.size
        with _peer_errors():
            dist.all_gather_object(gathered, entries)
        return [entry for part in gathered for entry in part]


@contextmanager
def spawn_workers(size: int, work: Callable[..., None], *arguments: Any) -> Iterator[None]:
    """Start the other processes of a group of `size`, of which this one is rank 0; each runs `work(group, *arguments)`.

    work: a module-level function, since processes are spawned. They end with this process, even if that is killed.
    Raises InputError if one of them ends: with its message, if it raised one.
    """
    if size == 1:
        yield
        return
    context = multiprocessing.get_context("spawn")
    with scratch_folder() as folder:
        store = folder / "store"
        others = [
            context.Process(target=_run, args=(rank, size, store, work, arguments), daemon=True)
            for rank in range(1, size)
        ]
        with safe_path():
            for process in others:
                process.start()
        _join(0, size, store)
        try:
            yield
        except ProcessEnded:
            messages = [path.read_text(encoding="utf-8") for path in sorted(folder.glob(ERROR_FILES))]
            if messages:
                raise InputError(messages[0]) from None
            raise
        finally:
            dist.destroy_process_group()
            for process in others:
                process.terminate()
                process.join()


def _run(rank: int, size: int, store: Path, work: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """A process other than rank 0. If another ends, the next exchange fails, which ends this process.

    The message of an InputError of its own stays in a file beside the store.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all processes; rank 0 handles it
    _join(rank, size, store)
    try:
        work(ProcessGroup(rank, size), *arguments)
    except ProcessEnded:
        os._exit(1)
    except InputError as error:
        with atomic_write(store.with_name(ERROR_FILES.replace("*", str(rank)))) as temporary:
            temporary.write_text(str(error), encoding="utf-8")
        os._exit(1)


def _join(rank: int, size: int, store: Path) -> None:
    if sys.platform in LOOPBACK:
        os.environ.setdefault(INTERFACE_VARIABLE, LOOPBACK[sys.platform])
    dist.init_process_group("gloo", store=dist.FileStore(str(store), size), rank=rank, world_size=size)


@contextmanager
def _peer_errors() -> Iterator[None]:
    """Raise ProcessEnded where gloo reports that a process has ended."""
    try:
        yield
    except RuntimeError as error:
        raise ProcessEnded(
            f"a training process ended ({str(error).splitlines()[0]}); repeat the command to resume"
        ) from None


def mean_entries(entries: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each value over the entries that contain it."""
    names = dict.fromkeys(name for entry in entries for name in entry)
    found = {name: [entry[name] for entry in entries if name in entry] for name in names}
    return {name: sum(values) / len(values) for name, values in found.items()}
