"""Views: pictures and cameras brought together, the ones to use chosen, and the arrays the network takes."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError, error_context
from ..geometry.baselines import nearest_neighbor_pairs, pairwise_baselines
from ..geometry.intrinsics import check_intrinsics
from ..geometry.rigid import check_rigid
from ..images.header import DamagedImage
from ..images.io import image_stem
from .depth_range import scene_depths
from .loader import FeatureImage, ImageCameraPair, ViewLoader
from .selection import MIN_VIEWS, score_pairs, select_views

EXAMPLES = 3  # names listed in a message

SAME_PLACE = 1e-4  # of the longest baseline
SAME_ROTATION = 1e-4  # largest difference of two rotation matrices
ROUNDINGS = 4  # of the distance from the origin, in steps of the poses' own type
RANGE_SLACK = 1e-3  # how far resampling may have carried a pixel outside [0, 1]


@dataclass(frozen=True, eq=False)
class ViewBatch:
    """What the network takes, and the cameras it came from.

    names: file names of the pictures, [views].
    images: float32 RGB in [0, 1], [views, 3, height, width].
    extrinsics: float64, camera-to-world, OpenCV axes, in the world frame and unit that the user gave, [views, 4, 4].
    intrinsics: float32, row 0 divided by the width and row 1 by the height, [views, 3, 3].
    cameras: the same cameras undistorted, at the full size of the pictures, [views].
    selection_reason: how these views were chosen of more, in words; empty where there was no selection.
    offset: what was subtracted from the user's world coordinates, float64 [3]; see `world_offset`.
    feature_images: the images for feature extraction, [views]; empty where every camera has a depth range.
    skipped: what is wrong with images that could not be read and were left out, a line for each.
    """

    names: list[str]
    images: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    cameras: list[Camera]
    selection_reason: str = ""
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    feature_images: Sequence[FeatureImage] = ()
    skipped: Sequence[str] = ()


def match_images_to_cameras(images: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[Path, Camera]]:
    """Give each picture the camera that names it, in the order of the pictures; cameras may be left over.

    Names are compared without suffix (a transforms.json often has none); of several such cameras the one with the same
    suffix, then the one with more folders in common, is taken. The order of the two lists plays no part.
    Raises InputError if a picture has no camera or several equally good ones, or two pictures have the same.
    """
    by_stem: dict[str, list[Camera]] = defaultdict(list)
    for camera in cameras:
        by_stem[image_stem(_path(camera.name))].append(camera)
    if not any(image_stem(image) in by_stem for image in images):
        raise InputError(
            f"none of {len(images)} images ({_examples(images)}) is named by one of {len(cameras)} cameras "
            f"({_examples([camera.name for camera in cameras])}); give the images that the cameras were made for"
        )
    taken: dict[str, Path] = {}
    pairs = []
    for image in images:
        candidates = by_stem.get(image_stem(image), [])
        if not candidates:
            names = _examples([camera.name for camera in cameras])
            raise InputError(
                f"{image}: none of {len(cameras)} cameras names it ({names}); leave it out or add its camera"
            )
        camera = _best(image, candidates)
        if camera.name in taken:
            raise InputError(f"{image} and {taken[camera.name]} both match the camera of {camera.name}; leave one out")
        taken[camera.name] = image
        pairs.append((image, camera))
    return pairs


def build_view_batch(
    pairs: Sequence[ImageCameraPair], count: int | None, height: int, width: int, skip_damaged: bool = False
) -> ViewBatch:
    """Take the pictures (only `count` well chosen ones, if given), undistort them and bring them to height x width.

    A picture is a file, or RGB [h, w, 3] in uint8, and is known by its camera's name. Each that is needed is read once.
    skip_damaged: do without pictures that cannot be read, and name them in `ViewBatch.skipped`.

    Raises InputError for fewer than two views, two cameras at the same pose, cameras without any baseline, a picture
    that cannot be read or has another size than its camera.
    """
    loader = ViewLoader(pairs, height, width)
    usable = list(range(len(pairs)))
    skipped: list[str] = []
    while True:
        if len(usable) < MIN_VIEWS:
            unread = f", {len(skipped)} cannot be read ({skipped[0]})" if skipped else ""
            image = "1 image" if len(usable) == 1 else f"{len(usable)} images"
            raise InputError(f"{image} with a camera, expected at least {MIN_VIEWS}{unread}; add images")
        try:
            return _prepared(loader, usable, count, skipped)
        except DamagedImage as error:
            damaged = {index for index in usable if isinstance(pairs[index][0], Path) and pairs[index][0] == error.path}
            if not skip_damaged or not damaged:
                raise
            skipped.append(str(error))
            usable = [index for index in usable if index not in damaged]


def _prepared(loader: ViewLoader, usable: Sequence[int], count: int | None, skipped: Sequence[str]) -> ViewBatch:
    """The views of these images, or of `count` of them."""
    selection_reason = ""
    if count is not None and count < len(usable):
        usable, selection_reason = _choose(loader, usable, count)
    cameras = [loader.pairs[index][1] for index in usable]
    extrinsics = np.stack([camera.extrinsics for camera in cameras])  # [views, 4, 4]
    _check_distinct(extrinsics, [camera.name for camera in cameras])
    loaded = [loader.load(index) for index in usable]
    feature_images = [view.sample for view in loaded if view.sample is not None]
    return ViewBatch(
        [_path(camera.name).name for camera in cameras],
        np.stack([view.image for view in loaded]),
        extrinsics,
        np.stack([view.intrinsics for view in loaded]),
        [view.camera for view in loaded],
        selection_reason,
        feature_images=feature_images if len(feature_images) == len(loaded) else (),
        skipped=skipped,
    )


def _choose(loader: ViewLoader, usable: Sequence[int], count: int) -> tuple[list[int], str]:
    """The `count` best of these images with cameras, and why, in words.

    How far the scene is decides what is a good baseline: cameras may know, and otherwise a few images are matched.
    Raises InputError as `select_views` does, or where an image cannot be read.
    """
    cameras = [loader.pairs[index][1] for index in usable]
    distances, source = scene_depths(cameras, lambda index: loader.sample(usable[index]))
    chosen = select_views(cameras, count, distances)
    between = score_pairs([cameras[index] for index in chosen], distances[chosen])
    i, j = np.array(nearest_neighbor_pairs(np.stack([cameras[index].extrinsics for index in chosen]))).T
    overlap, parallax = between.overlap[i, j], between.parallax[i, j]
    share = f"{100 * overlap.min():.0f} %" + (" or more" if len(i) > 1 else "")
    angles = " to ".join(dict.fromkeys(f"{angle:.1f}" for angle in (parallax.min(), parallax.max())))
    selection_reason = (
        f"neighbours share {share} of their view and stand {angles} degrees apart as seen from the scene, which is "
        f"{np.median(distances[chosen]):.3g} away by {source}"
    )
    return [usable[index] for index in chosen], selection_reason


def check_view_arrays(images: Any, extrinsics: Any, intrinsics: Any, near: Any = None, far: Any = None) -> None:
    """Check what the network is given, as `ViewBatch` describes it; near and far are one number or one for each view.

    What is None of them is yet to be found.

    Raises InputError naming the argument and the view: wrong shape or type, NaN, a pose that is not rigid, intrinsics
    that are not normalised, pixels outside [0, 1], not 0 < near < far, fewer than two views, cameras that coincide.
    """
    images = _floats(images, "images", "[views, 3, height, width]", (None, 3, None, None))
    views = len(images)
    extrinsics = _floats(extrinsics, "extrinsics", "[views, 4, 4]", (views, 4, 4))
    intrinsics = _floats(intrinsics, "intrinsics", "[views, 3, 3]", (views, 3, 3))
    if views < MIN_VIEWS:
        raise InputError(f"images: {views} view given, expected at least {MIN_VIEWS}")
    low, high = images.min(), images.max()
    if low < -RANGE_SLACK or high > 1 + RANGE_SLACK:
        raise InputError(f"images: values from {low:g} to {high:g}, expected 0 to 1; divide 8-bit pixels by 255")
    for index in range(views):
        with error_context(f"extrinsics[{index}]"):
            check_rigid(extrinsics[index])
        with error_context(f"intrinsics[{index}], normalised (row 0 divided by the width, row 1 by the height)"):
            check_intrinsics(intrinsics[index], 1, 1)
    _check_distinct(extrinsics, [f"view {index}" for index in range(views)])
    _check_range(near, far, views)


# ---- matching names


def _path(name: str) -> PurePosixPath:
    return PurePosixPath(name.replace("\\", "/"))  # files written on Windows


def _best(image: Path, candidates: Sequence[Camera]) -> Camera:
    """The candidate that agrees most with the image's path; raises InputError if two do equally."""
    agreement = [_agreement(image, _path(camera.name)) for camera in candidates]
    best = [camera for camera, value in zip(candidates, agreement, strict=True) if value == max(agreement)]
    if len(best) > 1:
        names = _examples([camera.name for camera in best])
        raise InputError(f"{image}: {len(best)} cameras match it equally ({names}); give it under one of these paths")
    return best[0]


def _agreement(image: Path, name: PurePosixPath) -> tuple[bool, int]:
    """Whether the file names are the same, and how many folders before them are."""
    folders = 0
    for ours, theirs in zip(reversed(image.parts[:-1]), reversed(name.parts[:-1]), strict=False):
        if ours != theirs:
            break
        folders += 1
    return image.name == name.name, folders


def _examples(names: Sequence[object]) -> str:
    return ", ".join(str(name) for name in names[:EXAMPLES]) + (", ..." if len(names) > EXAMPLES else "")


# ---- poses


def _check_distinct(extrinsics: np.ndarray, names: Sequence[str]) -> None:
    """Refuse cameras without any baseline, and two cameras at one pose."""
    baselines = pairwise_baselines(extrinsics)
    rounding = ROUNDINGS * float(np.finfo(extrinsics.dtype).eps * np.abs(extrinsics[:, :3, 3]).max())
    if baselines.max() <= rounding:
        raise InputError(
            f"{names[0]} and {names[1]} stand at the same place, as do all cameras; depth needs a baseline"
        )
    rotations = extrinsics[:, :3, :3]
    for first in range(len(extrinsics)):
        same_rotation = np.abs(rotations - rotations[first]).max(axis=(1, 2)) <= SAME_ROTATION
        same_place = baselines[first] <= max(SAME_PLACE * baselines.max(), rounding)
        for second in range(first + 1, len(extrinsics)):
            if same_rotation[second] and same_place[second]:
                raise InputError(f"{names[first]} and {names[second]} have the same pose, expected two; leave one out")


# ---- arrays


def _floats(array: Any, name: str, expected: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """The argument as an array, once its type, shape (None: any) and values are in order."""
    try:
        array = np.asarray(array)
    except ValueError:  # rows of different lengths
        raise InputError(f"{name}: not an array, expected {expected}") from None
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"{name}: type {array.dtype}, expected float32, {expected}")
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits or array.size == 0:
        given = f", {shape[0]} views being given" if shape[0] is not None else ""
        raise InputError(f"{name}: shape {array.shape}, expected {expected}{given}")
    if not np.isfinite(array).all():
        view = int(np.argwhere(~np.isfinite(array))[0, 0])
        raise InputError(f"{name}[{view}]: holds NaN or infinity, expected finite numbers")
    return array


def _check_range(near: Any, far: Any, views: int) -> None:
    for name, value in (("near", near), ("far", far)):
        if value is None:
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiu" or array.shape not in ((), (views,)):
            raise InputError(f"{name}: {array.dtype}, shape {array.shape}, expected a number, or {views} of them")
        if not np.isfinite(array).all():
            raise InputError(f"{name}: holds NaN or infinity, expected finite distances")
        if array.min() <= 0:
            least = f"{name}: {array.min():g}"
            raise InputError(f"{least}, expected a distance above 0, in the unit of the camera positions")
    if near is None or far is None:
        return
    nearest, farthest = np.broadcast_arrays(np.asarray(near), np.asarray(far))
    if (farthest <= nearest).any():
        raise InputError(f"far: {farthest.min():g}, expected beyond near, which is {nearest.max():g}")
