"""Example inputs for tracing, calibration and verification: noise, and images of a synthetic room.

Every camera sees the same room, whose walls and spheres are textured.
"""

import numpy as np
import torch
from torch import Tensor, nn

from ..runtime.inference.metadata import INPUTS

# The room: half its width and height, and the depth of its back wall, in a unit that is the near end of the depths.
HALF_WIDTH, HALF_HEIGHT, BACK = 5.0, 3.0, 16.0
# Spheres in it: x, y, z, radius; y points down.
SPHERES = ((-1.2, 0.8, 5.0, 1.0), (1.6, 1.4, 7.0, 1.5), (0.3, -0.6, 10.0, 1.2))
LIGHT = (0.4, -0.8, -0.45)
AMBIENT = 0.4
# Texture: waves of random direction, mostly grey, whose amplitude falls with the frequency, as in natural images.
WAVES, LOWEST_FREQUENCY, HIGHEST_FREQUENCY = 48, 0.4, 24.0  # radians in a unit
CONTRAST, COLOURFULNESS, DECAY = 0.12, 0.35, 0.5
LEVELS = 255  # of an image file


def room_inputs(views: int, height: int, width: int, near: float, far: float) -> dict[str, Tensor]:
    """The cameras of `example_inputs`, with images of the room."""
    return with_room(example_inputs(views, height, width, near, far), near)


def with_room(inputs: dict[str, Tensor], unit: float) -> dict[str, Tensor]:
    """The same inputs with images of the room, ray cast from their cameras: every view shows the same scene."""
    extrinsics, intrinsics = (inputs[name].double().numpy() for name in ("extrinsics", "intrinsics"))
    height, width = inputs["images"].shape[2:]
    images = [_render(pose, k, height, width, unit) for pose, k in zip(extrinsics, intrinsics, strict=True)]
    return inputs | {"images": torch.from_numpy(np.stack(images))}


def _render(pose: np.ndarray, intrinsics: np.ndarray, height: int, width: int, unit: float) -> np.ndarray:
    """The image [3, height, width] in [0, 1] from a camera-to-world pose and normalised intrinsics."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3].T
    origin = pose[:3, 3] / unit
    points, normals = _first_hits(origin, rays)
    shade = AMBIENT + (1 - AMBIENT) * np.abs(normals @ np.array(LIGHT))
    image = np.clip(_texture(points) * shade[..., None], 0, 1)
    return (np.rint(image * LEVELS) / LEVELS).astype(np.float32).transpose(2, 0, 1)


def _first_hits(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First intersections of rays [h, w, 3] from a point in the room with its surfaces, and the normals there."""
    walls = np.array([HALF_WIDTH, HALF_HEIGHT, BACK])
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (np.sign(rays) * walls - origin) / rays
    axis = np.where(np.isfinite(distances), distances, np.inf).argmin(-1)
    distance = np.take_along_axis(distances, axis[..., None], -1)[..., 0]
    normals = -np.sign(rays) * np.eye(3)[axis]
    squared = (rays**2).sum(-1)
    for *centre, radius in SPHERES:
        offset = origin - np.array(centre)
        half = rays @ offset
        root = half**2 - squared * (offset @ offset - radius**2)
        nearest = (-half - np.sqrt(np.maximum(root, 0))) / squared
        hit = (root > 0) & (nearest > 0) & (nearest < distance)
        distance = np.where(hit, nearest, distance)
        normals = np.where(hit[..., None], (offset + rays * nearest[..., None]) / radius, normals)
    return origin + rays * distance[..., None], normals


def _texture(points: np.ndarray) -> np.ndarray:
    """Colours [h, w, 3] at points [h, w, 3] of the room."""
    rng = np.random.default_rng(0)
    frequencies = np.geomspace(LOWEST_FREQUENCY, HIGHEST_FREQUENCY, WAVES)
    colours = np.full(points.shape, 0.5)
    for frequency in frequencies:
        direction, phase = rng.standard_normal(3), rng.uniform(0, 2 * np.pi)
        amplitude = rng.standard_normal() + COLOURFULNESS * rng.standard_normal(3)
        amplitude *= CONTRAST * (LOWEST_FREQUENCY / frequency) ** DECAY
        colours += np.sin(points @ (direction * frequency / np.linalg.norm(direction)) + phase)[..., None] * amplitude
    return colours


def example_inputs(views: int, height: int, width: int, near: float, far: float) -> dict[str, Tensor]:
    """Cameras on an arc, and images of noise at several scales, by the names of `INPUTS`.

    views, height, width: of the images. near, far: the depth range, in scene units.
    """
    generator = torch.Generator().manual_seed(views)
    images = torch.zeros(views, 3, height, width)
    for size in (2, 4, 8, 16):
        noise = torch.rand(views, 3, height // size + 1, width // size + 1, generator=generator)
        images += nn.functional.interpolate(noise, (height, width), mode="bilinear", align_corners=True) / 4
    angle = torch.linspace(-0.1, 0.1, views)
    extrinsics = torch.eye(4).repeat(views, 1, 1)
    extrinsics[:, 0, 0] = extrinsics[:, 2, 2] = angle.cos()
    extrinsics[:, 0, 2], extrinsics[:, 2, 0] = -angle.sin(), angle.sin()
    extrinsics[:, 0, 3] = near * torch.linspace(-0.4, 0.4, views)
    extrinsics[:, 1, 3] = near * 0.1 * torch.rand(views, generator=generator)
    intrinsics = torch.tensor([[0.9, 0.0, 0.52], [0.0, 0.9, 0.47], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    values = (images, extrinsics, intrinsics, torch.full((views,), near), torch.full((views,), far))
    return dict(zip(INPUTS, values, strict=True))
