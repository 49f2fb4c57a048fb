"""Calibration inputs from images: groups of views that see the same, as inference would prepare them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..runtime.cameras.io import read_cameras
from ..runtime.errors import InputError
from ..runtime.inference.metadata import INPUTS, ModelMetadata
from ..runtime.inference.normalization import SceneNormalization
from ..runtime.system.files import scratch_folder
from ..runtime.system.progress import progress
from ..runtime.views.batch import build_view_batch, match_images_to_cameras
from ..runtime.views.depth_range import estimate_depth_range
from ..runtime.views.groups import nearest_views
from ..runtime.views.loader import ImageCameraPair
from ..runtime.views.selection import guess_scene_depths
from ..runtime.views.sources import find_input_images

MAX_GROUPS = 8  # more move the ranges little


def read_examples(images: Path, cameras: Path, metadata: ModelMetadata) -> list[dict[str, np.ndarray]]:
    """The network's inputs, by name, for up to `MAX_GROUPS` groups of images.

    images: a folder, a glob, a file or a video. cameras: a file or folder of any known format. Views and size are those
    of the graph, or of the training where they are dynamic.
    Raises InputError for images or cameras that cannot be used, and for fewer images than a static graph takes.
    """
    count = metadata.fixed_views or metadata.trained_views[0]
    with scratch_folder() as folder:
        paths = find_input_images([images], cameras, None, folder)
        pairs = match_images_to_cameras(paths, read_cameras(cameras, paths))
        if len(pairs) < metadata.fixed_views:
            raise InputError(
                f"--calibrate {images}: {len(pairs)} images with cameras, and the graph takes {metadata.fixed_views} "
                "views; add images"
            )
        matched = [camera for _, camera in pairs]
        partners = nearest_views(matched, guess_scene_depths(matched), count - 1)
        starts = np.unique(np.linspace(0, len(pairs) - 1, min(MAX_GROUPS, len(pairs))).round().astype(int))
        groups = [[pairs[index] for index in (start, *partners[start])] for start in starts]
        return [_inputs(group, metadata) for group in progress(groups, "reading images for calibration")]


def _inputs(pairs: Sequence[ImageCameraPair], metadata: ModelMetadata) -> dict[str, np.ndarray]:
    """The inputs for one group, in the frame and unit of the training."""
    views = build_view_batch(pairs, None, metadata.height, metadata.width)
    trained = metadata.near, metadata.far
    span = estimate_depth_range(
        views.images, views.extrinsics, views.intrinsics, views.cameras, trained, matcher=views.matcher
    )
    near, far = (np.full(len(pairs), depth) for depth in (span.near, span.far))
    frame = SceneNormalization.of(views.extrinsics, near, metadata.near)
    arrays = (views.images, frame.apply(views.extrinsics), views.intrinsics, near * frame.scale, far * frame.scale)
    return {name: np.ascontiguousarray(array, np.float32) for name, array in zip(INPUTS, arrays, strict=True)}
