"""Cameras as captures have them: orbits, walks and grids."""

from dataclasses import replace

import numpy as np
from idesplat.runtime.cameras.camera import Camera

K = np.array([[70.0, 0, 42], [0, 72, 29], [0, 0, 1]])


def camera(name, position=(0, 0, 0), **changes):
    """A camera of 80 x 60 pixels at a position, looking along z."""
    extrinsics = np.eye(4)
    extrinsics[:3, 3] = position
    return replace(Camera(name, 80, 60, K, extrinsics), **changes)


def orbit(angles_deg, radius=4.0, centre=(10.0, -3.0, 5.0)):
    """Cameras on a circle that look at its centre, [cameras, 4, 4]."""
    poses = []
    for angle in np.radians(angles_deg):
        forward = np.array([np.sin(angle), 0, np.cos(angle)])
        down = np.array([0.0, 1, 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
        pose[:3, 3] = np.array(centre) - radius * forward
        poses.append(pose)
    return np.stack(poses)


def at(poses):
    """A camera at each pose."""
    return [camera(str(index), extrinsics=pose) for index, pose in enumerate(poses)]


def captures(count, seed=0):
    """Poses around an object, on a dome, in a grid from the air, walking ahead, and anywhere, [cameras, 4, 4] each."""
    rng = np.random.default_rng(seed)

    def look(position, target):
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross([0.0, 1, 0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = position
        return pose

    dome = rng.normal(size=(count, 3))
    dome *= 5 / np.linalg.norm(dome, axis=1, keepdims=True)
    side = int(np.sqrt(count))
    grid = np.stack([np.eye(4)] * side**2)
    grid[:, :2, 3] = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 8.0
    ahead = np.stack([np.eye(4)] * count)
    ahead[:, 2, 3], ahead[:, :2, 3] = np.arange(count) * 0.05, rng.normal(size=(count, 2)) * 0.01
    anywhere = rng.uniform(-3, 3, (count, 2, 3))
    return {
        "orbit": orbit(np.linspace(0, 360, count, endpoint=False)),
        "dome": np.stack([look(position, np.zeros(3)) for position in dome]),
        "grid": grid,
        "ahead": ahead,
        "anywhere": np.stack([look(position, target) for position, target in anywhere]),
    }
