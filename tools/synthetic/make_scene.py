"""The command `python -P -m idesplat.tools.synthetic.make_scene`: a synthetic room as images, cameras and depth.

    OUT_DIR/images/000.png ...     the images
    OUT_DIR/transforms.json        their cameras, as nerfstudio writes them
    OUT_DIR/depth/000.npz ...      exact z-depth at the pixel centres, `depth` [height, width], in scene units

It serves wherever images with known cameras and depth are needed, without a download.
"""

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from ...runtime.cli.options import Overwrite
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say
from ...runtime.geometry.intrinsics import denormalize_intrinsics
from ...runtime.system.files import atomic_write
from ...runtime.system.outputs import outputs

if TYPE_CHECKING:  # for a fast start: the ray caster is loaded when it is needed
    from .layout import Layout

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
SEED = 2  # of the room in the documentation
FIELD_OF_VIEW = 62.0  # degrees, of the longer side
PATH_LENGTH = 0.3  # from the first camera to the last, relative to the median depth
SAMPLES = 12  # rays per pixel
BRIGHTNESS = 0.45  # mean of the first image
CANDIDATES = 60  # random camera paths, of which the best is taken
CLEARANCE = 0.3  # least depth in view, relative to the median depth
LAMP = 0.3  # half length of the lamp that casts shadows, in metres


@command("make_scene")
def make_scene(
    out_dir: Annotated[Path, typer.Argument(help="Folder to write to.", show_default=False)],
    seed: Annotated[int, typer.Option(help="Random seed of the room.", min=0)] = SEED,
    views: Annotated[int, typer.Option(help="Number of images, along an arc.", min=2, max=1000)] = 8,
    height: Annotated[int, typer.Option(help="Of the images, in pixels.", min=16, max=8192)] = 480,
    width: Annotated[int, typer.Option(help="Of the images, in pixels.", min=16, max=8192)] = 640,
    overwrite: Overwrite = False,
) -> None:
    """Render images of a synthetic furnished room, with its cameras and exact depth."""
    from ...runtime.images.png import save_png
    from .layout import furnished_room
    from .sampler import scene_textures
    from .views import render

    images, depths, cameras = out_dir / "images", out_dir / "depth", out_dir / "transforms.json"
    names = [f"{index:03}" for index in range(views)]
    files = [images / f"{name}.png" for name in names] + [depths / f"{name}.npz" for name in names]
    outputs().writes("", [*files, cameras])
    rng = np.random.default_rng(seed)
    textures = scene_textures(seed)
    layout = furnished_room(rng, textures)
    intrinsics = _intrinsics(width, height)
    scene = layout.scene._replace(light_lengths=np.where(np.arange(len(layout.scene.light_lengths)) == 0, LAMP, -1.0))
    poses = _path(rng, layout, intrinsics, views)

    exposure = 1.0
    for index, pose in enumerate(_with_progress(poses)):
        image, depth = render(scene, textures, pose, intrinsics, height, width, SAMPLES)
        if index == 0:
            exposure = BRIGHTNESS / max(float(image.mean()), 1e-3)
        save_png(images / f"{index:03}.png", exposure * image)
        with atomic_write(depths / f"{index:03}.npz") as temporary:
            np.savez_compressed(temporary, depth=depth)
    with atomic_write(cameras) as temporary:
        temporary.write_text(json.dumps(_transforms(poses, intrinsics, width, height), indent=1) + "\n")
    say(f"{views} images in {images}, their cameras in {cameras}, true depth in {depths}")


def main() -> None:
    """Run the command."""
    run(make_scene)


def _intrinsics(width: int, height: int) -> np.ndarray:
    """Normalised intrinsics of FIELD_OF_VIEW: row 0 divided by the width, row 1 by the height, [3, 3]."""
    focal = 0.5 / np.tan(np.radians(FIELD_OF_VIEW) / 2) * max(width, height)  # pixels
    return np.array([[focal / width, 0, 0.5], [0, focal / height, 0.5], [0, 0, 1]])


def _path(rng: np.random.Generator, layout: "Layout", intrinsics: np.ndarray, views: int) -> np.ndarray:
    """Camera-to-world poses [views, 4, 4] on a shallow arc: of CANDIDATES, that with the most depth edges in view."""
    from .views import depth_edge_share, look_at, probe

    best, best_score = np.empty(0), -np.inf
    for _ in range(CANDIDATES):
        middle = look_at(rng.uniform(*layout.eye_bounds), rng.uniform(*layout.focus_bounds))
        distance = float(np.median(probe(layout.scene, middle, intrinsics)))
        poses = _arc(middle, distance, views)
        seen = [probe(layout.scene, pose, intrinsics) for pose in (poses[0], middle, poses[-1])]
        clearance = min(depth.min() for depth in seen) / distance
        score = min(depth_edge_share(depth) for depth in seen) if clearance > CLEARANCE else clearance - CLEARANCE
        if score > best_score:
            best, best_score = poses, score
    return best


def _arc(middle: np.ndarray, distance: float, views: int) -> np.ndarray:
    """Poses [views, 4, 4] to both sides of `middle`, looking at a point at 1.5 times `distance` in front of it."""
    from .views import look_at

    right, down, forward, eye = middle[:3].T
    steps = np.linspace(-0.5, 0.5, views)
    shifts = steps[:, None] * right - 0.15 * np.sin(2 * np.pi * steps)[:, None] * down
    focus = eye + 1.5 * distance * forward
    return np.stack([look_at(eye + PATH_LENGTH * distance * shift, focus) for shift in shifts])


def _transforms(poses: np.ndarray, intrinsics: np.ndarray, width: int, height: int) -> dict[str, Any]:
    """The content of transforms.json: intrinsics in pixels, camera-to-world with OpenGL axes."""
    (fl_x, _, cx), (_, fl_y, cy) = denormalize_intrinsics(intrinsics, width, height)[:2].tolist()
    frames = [
        {"file_path": f"images/{index:03}.png", "transform_matrix": (pose @ OPENGL_AXES).tolist()}
        for index, pose in enumerate(poses)
    ]
    size = {"camera_model": "OPENCV", "w": width, "h": height}
    return {**size, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, "frames": frames}


def _with_progress(poses: np.ndarray) -> Iterable[np.ndarray]:
    """The poses, with a progress bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        return poses

    return track(poses, "rendering", console=Console(stderr=True))


if __name__ == "__main__":
    main()
