"""Scenes of grey solids in a box, for tests of the ray caster."""

import numpy as np
from idesplat.tools.synthetic.builder import Cut
from idesplat.tools.synthetic.raycast import BOX, UNCUT
from idesplat.tools.synthetic.scene import WAVES, Scene
from idesplat.tools.synthetic.textures import LEVELS, SIZE, Textures

GREY = Textures(np.full((1, sum((SIZE >> level) ** 2 for level in range(LEVELS)), 3), 128, np.uint8), ("plain",))
ROOM = (BOX, (0.0, 0.0, 0.0), (10.0, 10.0, 10.0), np.eye(3))


def scene_of(*solids: tuple[int, tuple[float, ...], tuple[float, ...], np.ndarray]) -> Scene:
    """Solids (shape, centre, halves, axes) of one grey material under one lamp that casts shadows."""
    shapes, centres, halves, axes = zip(ROOM, *solids, strict=True)
    return Scene(
        shapes=np.array(shapes),
        centres=np.array(centres),
        axes=np.array(axes),
        halves=np.array(halves),
        cut_shapes=np.full(len(shapes), UNCUT),
        cuts=np.zeros((len(shapes), 3, 4)),
        waves=np.zeros((len(shapes), WAVES, 5)),
        forms=np.zeros((len(shapes), 2)),
        materials=np.zeros((len(shapes), 6), np.int64),
        textures=np.zeros(1, np.int64),
        uv=np.eye(2, 3)[None],
        colours=np.eye(3, 4)[None],
        frequencies=np.ones(1),
        speculars=np.zeros(1),
        emissions=np.zeros(1),
        light_positions=np.array([[0.0, -9.0, 0.0]]),
        light_colours=np.full((1, 3), 0.5),
        light_reaches=np.array([1e9]),
        light_lengths=np.array([0.0]),
        ambient=np.full(3, 0.25),
    )


def less(scene: Scene, cut: Cut) -> Scene:
    """A scene of one solid in the room, with a cut in that solid."""
    return scene._replace(cut_shapes=np.array([UNCUT, cut.shape]), cuts=np.stack([np.zeros((3, 4)), cut.frame]))


def rotation_about_y(degrees: float) -> np.ndarray:
    """Axes rotated about y."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def pixel_rays(intrinsics: np.ndarray, height: int, width: int) -> np.ndarray:
    """Rays with z = 1 through the pixel centres, camera frame, [height, width, 3]."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T


WIDE_ANGLE = np.array([[0.7, 0, 0.48], [0, 0.9, 0.53], [0, 0, 1]])
