"""The README's picture: two photographs of the drawn room, their depth, and a view between them drawn from splats.

    python -m idesplat.tools.picture demo/scene docs/picture.png

No trained weights are carried yet, so the splats stand at the room's true depth: the picture shows what files,
conventions and rasteriser make of a good depth map, not what a network predicts.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ..runtime.cameras import Camera, read_cameras
from ..runtime.errors import InputError, exit_on_input_error
from ..runtime.gaussians import Gaussians
from ..runtime.images import load_image
from ..runtime.images_out import save_depth_png, save_png
from ..runtime.paths import interpolate_extrinsics
from ..runtime.render import draw_view

VIEWS = (2, 4)
OPACITY = 0.95
SH_C0 = 0.28209479177387814
# Splats' standard deviation in pixels: neighbours overlap, and edges stay sharp.
SPREAD = 0.5


@exit_on_input_error
def picture(
    scene: Annotated[Path, typer.Argument(help="Folder that make_scene wrote.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="The .png to write.", show_default=False)],
) -> None:
    """Draw photograph, depth, view between, depth, photograph, side by side."""
    import cv2

    cameras = [read_cameras(scene / "transforms.json")[view] for view in VIEWS]
    photographs = [load_image(scene / camera.name) for camera in cameras]
    depths = [_read_depth(scene / "depth" / f"{Path(camera.name).stem}.npz") for camera in cameras]
    parts = [splats(*view) for view in zip(photographs, depths, cameras, strict=True)]
    fields = ("means", "scales", "quats", "opacities", "sh")
    gaussians = Gaussians(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))
    middle = interpolate_extrinsics(np.stack([camera.extrinsics for camera in cameras]), 3)[1]
    between = draw_view(gaussians, middle, cameras[0].K, cameras[0].width, cameras[0].height).rgb
    save_depth_png(out, depths[0])
    depth = load_image(out)
    strip = [photographs[0] / 255, depth / 255, between, photographs[1] / 255]
    save_png(out, cv2.resize(np.hstack(strip).astype(np.float32), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    print(f"wrote {out}")


def splats(photograph: np.ndarray, depth: np.ndarray, camera: Camera) -> Gaussians:
    """One round splat a pixel: photograph [h, w, 3] in uint8, z-depth [h, w] -> Gaussians in the world."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.K).T
    points = rays * depth.reshape(-1, 1)
    means = points @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]
    count = len(means)
    scales = np.repeat(SPREAD * depth.reshape(-1, 1) / camera.K[0, 0], 3, axis=1)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = (photograph.reshape(-1, 1, 3) / 255 - 0.5) / SH_C0
    values = (means, scales, quats, np.full(count, OPACITY), sh)
    return Gaussians(*(value.astype(np.float32) for value in values))


def _read_depth(path: Path) -> np.ndarray:
    try:
        with np.load(path) as file:
            return file["depth"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: no readable depth ({error}); make the folder with make_scene") from None


def main() -> None:
    """Run the command."""
    typer.run(picture)


if __name__ == "__main__":
    main()
