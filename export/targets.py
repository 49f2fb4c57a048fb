"""What a graph is exported for, and how: CPUs, GPUs or WebGPU in a browser, the opset, the form of the files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..runtime.errors import InputError

if TYPE_CHECKING:
    import numpy as np

MIB = 1 << 20
# TorchScript's exporter writes up to 20. Opset 21 has the same operators with more types.
MIN_OPSET, MAX_TRACED_OPSET, MAX_OPSET = 17, 20, 21
OPSET = 20


@dataclass(frozen=True)
class Target:
    """How graphs for a kind of device differ.

    gather_bytes: gathers are unrolled into as few chunks as keep each tensor within this; None for a Loop, which on
    CPUs keeps them in the cache.
    """

    name: str
    gather_bytes: int | None


CPU, GPU, WEB = "cpu", "gpu", "web"
TARGETS = {
    target.name: target
    for target in (
        Target(CPU, None),
        Target(GPU, 1024 * MIB),
        Target(WEB, 128 * MIB),  # the largest binding that every WebGPU adapter has
    )
}


@dataclass(frozen=True)
class GraphSettings:
    """How graphs are written.

    verify: whether they are compared with PyTorch. external_data: whether weights go to a file of their own.
    calibration: inputs of the network, by name, on which int8 ranges are found instead of noise and a synthetic room.
    """

    target: Target = TARGETS[CPU]
    opset: int = OPSET
    verify: bool = True
    external_data: bool = False
    calibration: "Sequence[Mapping[str, np.ndarray]]" = ()


def parse_target(name: str) -> Target:
    """The target of this name; raises InputError if there is none."""
    if name not in TARGETS:
        raise InputError(f"--target {name}: unknown; choose one of {', '.join(TARGETS)}")
    return TARGETS[name]


def check_opset(opset: int) -> int:
    """The opset; raises InputError if no graph can be written for it."""
    if not MIN_OPSET <= opset <= MAX_OPSET:
        raise InputError(f"--opset {opset}: expected {MIN_OPSET} to {MAX_OPSET}")
    return opset
