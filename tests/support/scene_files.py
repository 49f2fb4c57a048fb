"""Scenes as files: chunks of the released datasets, small splat files, and what a folder holds."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.splats.formats.ply import write_ply
from idesplat.runtime.splats.gaussians import Gaussians


def as_scene(folder: Path, key: str) -> dict[str, Any]:
    """A folder of images with transforms.json as a scene of a RealEstate10K chunk."""
    rows, images = [], []
    for camera in read_cameras(folder / "transforms.json"):
        (fx, _, cx), (_, fy, cy) = camera.K[:2] / [[camera.width], [camera.height]]
        world_to_camera = np.linalg.inv(camera.extrinsics)[:3]
        rows.append([fx, fy, cx, cy, 0, 0, *world_to_camera.ravel()])
        encoded = cv2.imencode(".jpg", cv2.imread(str(folder / camera.name)))[1]
        images.append(torch.from_numpy(encoded.ravel()))
    cameras = torch.tensor(rows, dtype=torch.float32)
    return {"url": "", "timestamps": torch.arange(len(rows)), "cameras": cameras, "images": images, "key": key}


# Written by pillow-heif, with orientation 6 and a focal length of 26 mm.
HEIC = Path(__file__).parent.parent / "data" / "turned.heic"
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def write_scene(path):
    """Write a .ply of 20 grey Gaussians."""
    rng = np.random.default_rng(0)
    quats, opacities = np.tile(np.float32([1, 0, 0, 0]), (20, 1)), np.full(20, 0.9, np.float32)
    means = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3)).astype(np.float32)
    write_ply(
        path, Gaussians(means, np.full((20, 3), 0.1, np.float32), quats, opacities, np.zeros((20, 1, 3), np.float32))
    )


def pinholes(names):
    """Cameras of 16 x 16 pixels side by side, one for each name."""
    K = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    poses = [np.array(IDENTITY, float) for _ in names]
    for index, pose in enumerate(poses):
        pose[0, 3] = 0.1 * index
    return [Camera(name, 16, 16, K, pose) for name, pose in zip(names, poses, strict=True)]


def snapshot(folder):
    """Every file and folder below, with its content and time of change."""
    return {
        path: (path.read_bytes(), path.stat().st_mtime_ns) if path.is_file() else None for path in folder.rglob("*")
    }
