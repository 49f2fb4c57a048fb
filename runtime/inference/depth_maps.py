"""Depth maps as files, with the cameras that are needed to unproject them.

For each view a .png with colours, and a .npz with

    depth       z-depth in world units, float32 [height, width]
    K           pixels of the depth map, pixel centres at .5, no distortion, float64 [3, 3]
    extrinsics  camera-to-world, OpenCV axes (x right, y down, z forward), float64 [4, 4]
    near, far   bounds of the depth hypotheses, world units
    image       the name of the image file
    image_size  width and height of the image, pixels
    crop        from pixels (x, y, 1) of the undistorted image to those of the depth map, float64 [3, 3]
    offset      what was subtracted from the user's world coordinates (--offset), float64 [3]

The pixel in column x and row y lies at `extrinsics[:3, :3] @ (depth[y, x] * inv(K) @ (x + .5, y + .5, 1)) +
extrinsics[:3, 3]`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..images.png import save_depth_png
from ..images.resizing import frame_crop
from ..system.files import atomic_write
from ..system.output_names import depth_map_files
from ..views.batch import ViewBatch
from .predictor import Prediction


def write_depth_maps(folder: Path, stems: Sequence[str], prediction: Prediction, views: ViewBatch) -> list[Path]:
    """Write a PNG and an archive of each view's depth into an existing folder; returns the paths written.

    stems: the files' names without suffix, all different, [views]. views: what was predicted from.
    Raises InputError if a file cannot be written.
    """
    written = []
    parts = zip(stems, prediction.depth, prediction.cameras, views.cameras, strict=True)
    for stem, depth, camera, original in parts:
        png, archive = depth_map_files(folder, [stem])
        save_depth_png(png, depth)
        near, far = camera.depth_range or (np.nan, np.nan)
        with atomic_write(archive) as temporary:
            np.savez_compressed(
                temporary,
                depth=depth,
                K=camera.K,
                extrinsics=camera.extrinsics,
                near=near,
                far=far,
                image=original.name,
                image_size=(original.width, original.height),
                crop=frame_crop(original.width, original.height, camera.width, camera.height).matrix,
                offset=views.offset,
            )
        written += [png, archive]
    return written
