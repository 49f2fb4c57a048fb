"""Verification cases: a synthetic room and noise, with cameras and depth ranges that differ by view.

A graph can be wrong for some inputs only. Other numbers of views take another branch of `nearest_views`, square images
hide swapped axes, equal intrinsics hide a view that uses another's, and the trained depth range hides one that was
traced as a constant. Noise excites every layer; a rendered image has flat areas, edges and consistent geometry.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...runtime.inference.metadata import ModelMetadata
from ..example_inputs import example_inputs, room_inputs, with_room
from ..stages import NamedTensors
from ..tracing import StaticShape

# With dynamic views; more than `ORDERED_VIEWS` of model/common/geometry.py, and more than a view has neighbours.
MAX_CASE_VIEWS = 5
# Spread over the views of focal lengths, principal points and near ends.
FOCAL_SPREAD, CENTRE_SPREAD, NEAR_SPREAD = 0.15, 0.04, 0.3
NEAR_FACTOR = 0.8  # of the trained near end
# Far over near, from the first view to the last: small, so that the far end matters in inverse depth.
MIN_RANGE, MAX_RANGE = 3.0, 6.0


@dataclass(frozen=True)
class Case:
    """Inputs, and what the network computes from them: every tensor between stages and every output, by name.

    rounded: what it computes where every entry of the cameras is the next larger float32.
    """

    name: str
    views: int
    tensors: dict[str, np.ndarray]
    rounded: dict[str, np.ndarray]


def verification_cases(network: NamedTensors, metadata: ModelMetadata, static: StaticShape) -> Iterator[Case]:
    """Cases of different numbers of views, sizes and contents, as far as views and size are dynamic."""
    near, far, block = metadata.near, metadata.far, metadata.size_multiple
    trained = static.size or (metadata.height, metadata.width)
    across, upright = (static.size or (rows * block, columns * block) for rows, columns in ((6, 8), (8, 6)))
    room = room_inputs(static.views or 2, *trained, near, far)
    yield _case(network, "room", room)
    noise = example_inputs(static.views or MAX_CASE_VIEWS, *across, near, far)
    yield _case(network, "noise", different_cameras(noise))
    case_near = NEAR_FACTOR * near
    cameras = different_cameras(example_inputs(static.views or 3, *upright, case_near, far))
    yield _case(network, "room", with_room(cameras, case_near))


def different_cameras(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same inputs with different intrinsics and depth ranges in each view."""
    views = len(inputs["images"])
    spread = torch.linspace(-1, 1, views)
    intrinsics = inputs["intrinsics"].clone()
    intrinsics[:, 0, 0] *= 1 + FOCAL_SPREAD * spread
    intrinsics[:, 1, 1] *= 1 + FOCAL_SPREAD * spread.flip(0)
    intrinsics[:, 0, 2] += CENTRE_SPREAD * spread
    intrinsics[:, 1, 2] -= CENTRE_SPREAD * spread
    near = inputs["near"] * (1 + NEAR_SPREAD * torch.linspace(0, 1, views))
    far = near * torch.linspace(MIN_RANGE, MAX_RANGE, views)
    return inputs | {"intrinsics": intrinsics, "near": near, "far": far}


def _case(network: NamedTensors, content: str, inputs: dict[str, Tensor]) -> Case:
    tensors, rounded = _computed(network, inputs), _computed(network, _next_cameras(inputs))
    views, _, height, width = inputs["images"].shape
    return Case(f"{content}, {views} views {height}x{width}", views, tensors, rounded)


@torch.no_grad()
def _computed(network: NamedTensors, inputs: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Inputs and what the network computes from them."""
    return {name: value.numpy() for name, value in {**inputs, **network.named(*inputs.values())}.items()}


def _next_cameras(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same inputs, with the next larger float32 for every entry of the cameras."""
    up = torch.tensor(torch.inf)
    return inputs | {name: torch.nextafter(inputs[name], up) for name in ("extrinsics", "intrinsics")}
