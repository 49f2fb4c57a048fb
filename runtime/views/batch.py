"""The view batch: images matched to cameras, views selected, and the arrays of the network's input."""

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..cameras.undistortion import UndistortedImage
from ..errors import InputError, error_context
from ..geometry.baselines import coinciding_poses, have_baseline, nearest_neighbor_pairs
from ..geometry.intrinsics import check_intrinsics
from ..geometry.rigid import check_rigid
from ..images.finding import image_stem
from ..images.header import DamagedImage
from .checks import Defect, find_defects
from .depth_range import scene_depths
from .loader import FeatureImage, ImageCameraPair, ViewLoader
from .matching import ViewMatcher
from .selection import MIN_VIEWS, score_pairs, select_views

LOG = logging.getLogger(__name__)

EXAMPLES = 3  # names listed in a message

RANGE_TOLERANCE = 1e-3  # by which resampling may exceed [0, 1]


@dataclass(frozen=True, eq=False)
class ViewBatch:
    """The network's input for a set of views, and their cameras.

    names: file names of the images, [views].
    images: float32 RGB in [0, 1], [views, 3, height, width].
    extrinsics: camera-to-world, OpenCV axes, in the input's world frame and unit, float64 [views, 4, 4].
    intrinsics: normalised (row 0 divided by the width, row 1 by the height), float32 [views, 3, 3].
    cameras: the cameras, undistorted, at the full size of the images, [views].
    selection_reason: why these views were selected, for the user; empty if all are used.
    offset: subtracted from the input's world coordinates, float64 [3]; see `world_offset`.
    feature_images: the images for feature extraction, [views]; empty where every camera has a depth range.
    skipped: a line for each image that was left out, which could not be read or has a defect.
    warnings: a line for each defect of an image that is used.
    copies: of the images for refinement, [views]; empty if not asked for.
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
    warnings: Sequence[str] = ()
    copies: Sequence[UndistortedImage] = ()

    @cached_property
    def matcher(self) -> ViewMatcher:
        """Points matched between the views; what it has matched is kept with the batch."""
        return ViewMatcher(self.images, self.extrinsics, self.intrinsics, self.feature_images)


def match_images_to_cameras(images: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[Path, Camera]]:
    """Pair each image with the camera that names it, in the order of the images; cameras may be left over.

    Names are compared without suffix, which a transforms.json often lacks. Among several such cameras, one with the
    same suffix is preferred, then one with more parent folders in common.
    Raises InputError if an image has no camera or several equally good ones, or if two images have the same camera.
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


def images_with_cameras(images: Sequence[Path], cameras: Sequence[Camera]) -> list[Path]:
    """The images that a camera names; all, if none is named."""
    named = {image_stem(_path(camera.name)) for camera in cameras}
    return [image for image in images if image_stem(image) in named] or list(images)


def build_view_batch(
    pairs: Sequence[ImageCameraPair],
    count: int | None,
    height: int,
    width: int,
    skip_damaged: bool = False,
    check_images: bool = False,
    check_cameras: bool = False,
    copy_side: int = 0,
) -> ViewBatch:
    """Load views, undistorted and resized to height x width.

    pairs: images, as files or uint8 RGB [h, w, 3], with their cameras. Each image that is needed is read once.
    count: select this many views; all by default.
    skip_damaged: leave out images that cannot be read or have a defect, and list them in `ViewBatch.skipped`.
    check_images: look for defects of the images that are used, as `checks` describes them; check_cameras: also for
    images that do not fit their cameras, which estimated ones do.
    copy_side: longer side of `ViewBatch.copies` in pixels; 0 for none.
    Raises InputError for fewer than two views, two cameras with the same pose, cameras without a baseline, or an image
    that cannot be read, whose size does not match its camera, or that has a defect; blurred images only give a warning.
    """
    loader = ViewLoader(pairs, height, width, match=check_images, copy_side=copy_side)
    usable = list(range(len(pairs)))
    skipped: list[str] = []
    while True:
        if len(usable) < MIN_VIEWS:
            lost = f", {len(skipped)} cannot be used ({skipped[0]})" if skipped else ""
            image = "1 image" if len(usable) == 1 else f"{len(usable)} images"
            raise InputError(f"{image} with a camera, expected at least {MIN_VIEWS}{lost}; add images")
        try:
            chosen, reason = _choose(loader, usable, count)
            defects = find_defects(loader, chosen, usable, check_cameras) if check_images else []
            left_out, warnings = _sort_defects(defects, len(usable), skip_damaged)
            if not left_out:
                return replace(_build(loader, chosen), selection_reason=reason, skipped=skipped, warnings=warnings)
            skipped += [defect.what for defect in left_out]
            unusable = {defect.index for defect in left_out}
        except DamagedImage as error:
            unusable = {
                index for index in usable if isinstance(pairs[index][0], Path) and pairs[index][0] == error.path
            }
            if not skip_damaged or not unusable:
                raise
            skipped.append(str(error))
        usable = [index for index in usable if index not in unusable]


def _sort_defects(defects: Sequence[Defect], usable: int, skip: bool) -> tuple[list[Defect], list[str]]:
    """The defects whose images are to be left out, and warnings of the others.

    Soft ones are no reason to have fewer than two views. Raises InputError for others, unless `skip`.
    """
    hard = [defect for defect in defects if not defect.soft]
    if hard and not skip:
        raise InputError(f"{hard[0].what}; leave it out or correct it")
    spare = usable - len(hard) - MIN_VIEWS if skip else 0
    soft = [defect for defect in defects if defect.soft]
    return [*hard, *soft[: max(spare, 0)]], [defect.what for defect in soft[max(spare, 0) :]]


def _choose(loader: ViewLoader, usable: Sequence[int], count: int | None) -> tuple[list[int], str]:
    """The indices of the views to use, and the reason, for the user, if these are not all."""
    if count is not None and count < len(usable):
        return _select(loader, usable, count)
    return list(usable), ""


def _build(loader: ViewLoader, chosen: Sequence[int]) -> ViewBatch:
    """The batch of the pairs with these indices."""
    cameras = [loader.pairs[index][1] for index in chosen]
    extrinsics = np.stack([camera.extrinsics for camera in cameras])  # [views, 4, 4]
    _check_distinct(extrinsics, [camera.name for camera in cameras])
    loaded = [loader.load(index) for index in chosen]
    feature_images = [view.feature_image for view in loaded if view.feature_image is not None]
    return ViewBatch(
        [_path(camera.name).name for camera in cameras],
        np.stack([view.image for view in loaded]),
        extrinsics,
        np.stack([view.intrinsics for view in loaded]),
        [view.camera for view in loaded],
        feature_images=feature_images if loader.needs_depth else (),
        copies=[view.copy for view in loaded if view.copy is not None],
    )


def _select(loader: ViewLoader, usable: Sequence[int], count: int) -> tuple[list[int], str]:
    """Select `count` of these pairs; returns their indices and the reason, for the user.

    The suitable baseline depends on the depth of the scene, which comes from the cameras or from matching a few images.
    Raises InputError as `select_views`, or if an image cannot be read.
    """
    cameras = [loader.pairs[index][1] for index in usable]
    depths, source = scene_depths(cameras, lambda index: loader.feature_image(usable[index]))
    chosen = select_views(cameras, count, depths)
    scores = score_pairs([cameras[index] for index in chosen], depths[chosen])
    i, j = np.array(nearest_neighbor_pairs(np.stack([cameras[index].extrinsics for index in chosen]))).T
    overlap, parallax = scores.overlap[i, j], scores.parallax[i, j]
    overlaps = f"{100 * overlap.min():.0f} %" + (" or more" if len(i) > 1 else "")
    angles = " to ".join(dict.fromkeys(f"{angle:.1f}" for angle in (parallax.min(), parallax.max())))
    selection_reason = (
        f"nearest neighbours overlap by {overlaps} with a parallax of {angles} degrees, at a scene depth of "
        f"{np.median(depths[chosen]):.3g} from {source}"
    )
    LOG.info("selected %s: %s", ", ".join(cameras[index].name for index in chosen), selection_reason)
    return [usable[index] for index in chosen], selection_reason


def check_view_arrays(images: Any, extrinsics: Any, intrinsics: Any, near: Any = None, far: Any = None) -> None:
    """Check the arrays of the network's input, as in `ViewBatch`.

    near, far: a number, or one for each view; None if not known yet.
    Raises InputError that names the argument and the view: wrong shape or type, NaN, a pose that is not rigid,
    intrinsics that are not normalised, pixels outside [0, 1], not 0 < near < far, fewer than two views, or coinciding
    cameras.
    """
    images = _floats(images, "images", "[views, 3, height, width]", (None, 3, None, None))
    views = len(images)
    extrinsics = _floats(extrinsics, "extrinsics", "[views, 4, 4]", (views, 4, 4))
    intrinsics = _floats(intrinsics, "intrinsics", "[views, 3, 3]", (views, 3, 3))
    if views < MIN_VIEWS:
        raise InputError(f"images: {views} view given, expected at least {MIN_VIEWS}")
    low, high = images.min(), images.max()
    if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
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
    """The camera whose name agrees most with the image's path. Raises InputError for a tie."""
    agreement = [_agreement(image, _path(camera.name)) for camera in candidates]
    best = [camera for camera, value in zip(candidates, agreement, strict=True) if value == max(agreement)]
    if len(best) > 1:
        names = _examples([camera.name for camera in best])
        raise InputError(f"{image}: {len(best)} cameras match it equally ({names}); give it under one of these paths")
    return best[0]


def _agreement(image: Path, name: PurePosixPath) -> tuple[bool, int]:
    """Whether the file names are equal, and how many parent folders are."""
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
    """Raise InputError for cameras without a baseline, and for two cameras with the same pose."""
    if not have_baseline(extrinsics):
        raise InputError(
            f"{names[0]} and {names[1]} are at the same position, as are all cameras; depth needs a baseline"
        )
    for first, second in coinciding_poses(extrinsics):
        raise InputError(f"{names[first]} and {names[second]} have the same pose, expected two; leave one out")


# ---- arrays


def _floats(array: Any, name: str, expected: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """The argument as an array with checked type, shape (None: any size) and finite values."""
    try:
        array = np.asarray(array)
    except ValueError:  # rows of different lengths
        raise InputError(f"{name}: not an array, expected {expected}") from None
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"{name}: type {array.dtype}, expected float32, {expected}")
    is_expected = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not is_expected or array.size == 0:
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
