"""The command idesplat-render: a splat file and cameras to pictures."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
import typer

from .cameras import Camera, read_cameras
from .errors import InputError, exit_on_input_error
from .files import make_folder
from .formats import read_scene
from .gaussians import Gaussians
from .images_out import save_png
from .rasterizer import Rendering, rasterize

BLACK = (0.0, 0.0, 0.0)


def draw_view(
    gaussians: Gaussians,
    extrinsics: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    width: int,
    height: int,
    background: tuple[float, float, float] = BLACK,
) -> Rendering:
    """Draw Gaussians from a camera given as the rest of the package has it: camera-to-world, K in pixels.

    Raises InputError as `rasterize` does.
    """
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        world_to_camera(extrinsics),
        K,
        width,
        height,
        background,
    )


def world_to_camera(extrinsics: np.ndarray) -> np.ndarray:
    """The viewmat [4, 4] of a rigid camera-to-world pose [4, 4]."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = extrinsics[:3, :3].T
    viewmat[:3, 3] = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    return viewmat


@exit_on_input_error
def render(
    scene: Annotated[Path, typer.Argument(help="Splat file of any format.", show_default=False)],
    cameras: Annotated[Path, typer.Option(help="Cameras, such as a transforms.json.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.", show_default=False)],
    background: Annotated[
        tuple[float, float, float], typer.Option(help="Red, green and blue behind the scene, 0 to 1.")
    ] = BLACK,
) -> None:
    """Draw a splat file as each of the cameras sees it: one PNG a camera, named after its image.

    Pictures have the camera's own size. They show the ideal pinhole view: where a camera has lens distortion, compare
    with the undistorted photograph.
    """
    if not all(0 <= value <= 1 for value in background):
        raise InputError(f"--background is {background}, expected red, green and blue from 0 to 1")
    views = read_cameras(cameras)
    targets = _targets(views, cameras.parent, out)
    gaussians = read_scene(scene)
    make_folder(out)
    for view, target in _with_progress(list(zip(views, targets, strict=True))):
        save_png(target, draw_view(gaussians, view.extrinsics, view.K, view.width, view.height, background).rgb)
    for target in targets:
        print(target)
    print(f"{len(gaussians)} Gaussians drawn in {len(targets)} pictures; open {out} in any image viewer")


def main() -> None:
    """Run the command."""
    typer.run(render)


def _targets(views: Sequence[Camera], image_folder: Path, out: Path) -> list[Path]:
    """The picture's file for each camera; raises InputError if one would overwrite another, or a photograph."""
    name_of: dict[Path, str] = {}
    for view in views:
        image = PurePosixPath(view.name.replace("\\", "/"))
        target = out / f"{image.stem}.png"
        if target in name_of:
            raise InputError(
                f"cameras {name_of[target]} and {view.name} would both be drawn to {target}; "
                "rename one image, or split the cameras into two files"
            )
        if target.resolve() == (image_folder / image).resolve():
            raise InputError(f"--out: the picture {target} would overwrite the photograph; choose another folder")
        name_of[target] = view.name
    return list(name_of)


def _with_progress(views: Sequence[tuple[Camera, Path]]) -> Iterable[tuple[Camera, Path]]:
    """The views, with a bar on stderr where that is a terminal."""
    if not sys.stderr.isatty():
        return views
    from rich.console import Console
    from rich.progress import track

    return track(views, "Drawing", console=Console(stderr=True))
