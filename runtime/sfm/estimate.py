"""Photographs without cameras: what `--cameras estimate` does.

Two images take OpenCV: SIFT, the essential matrix, triangulation; their lenses are taken to have no distortion and
their axis in the middle of the image_path. More take COLMAP's mapper. The world is the first image's camera, and its
unit the median depth of the points that were found, since images know no unit.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError, error_context
from ..geometry.depth_bounds import depth_bounds
from ..geometry.intrinsics import check_intrinsics, intrinsic_matrix
from ..geometry.rigid import invert_rigid
from ..images.exif import exif_focal, parse_focal
from ..images.header import DamagedImage
from ..images.io import load_image
from ..system.progress import progress, working
from .features import Features, extract_features, match_features, normalize_points
from .two_view import TwoViewGeometry, estimate_relative_pose, rotation_only_inlier_ratio

DECODED_BYTES = 1 << 29  # of images that are kept, so that those that are chosen later need not be read again
LONGEST_SIDE = 1600  # pixels, in which features are looked for
PIXELS_OFF = 1.5  # at that size: how far from its epipolar line a match may lie
FEWEST_MATCHES = 40
MOST_BY_TURNING = 0.7  # of the matches may be explained by a camera that only turned
LEAST_SHARE = 0.3  # of the matches must agree
LEAST_PARALLAX_DEG = 1.5  # below, the direction from one camera to the other is mostly noise


@dataclass(frozen=True, eq=False)
class UncalibratedImage:
    """A image before its camera is known. features: in pixels of its own size; focal: pixels, if known."""

    path: Path
    width: int
    height: int
    features: Features
    focal: float | None


def estimate_cameras(
    images: Sequence[Path],
    focal: str | None = None,
    skipped: list[str] | None = None,
    decoded: dict[Path, np.ndarray] | None = None,
) -> list[Camera]:
    """Cameras for images of one scene that does not move; of more than two, those that could be registered.

    focal: the focal length of all, in pixels (`1375`) or on 35 mm film (`26mm`); else each one's EXIF data tells, and
    with more than two images it is found where neither does.
    skipped: receives a line for each image that is damaged or the same as another one, and is left out; where it
    is None, that is an error. decoded: receives the images as they were read, up to DECODED_BYTES.
    The first camera is the world's origin, the median depth of what is seen is 1, and `depth_range` is set.
    Raises InputError for fewer than two images, two without focal length, too few common points, too little
    parallax, more than two images without pycolmap, or where nothing fits together.
    """
    if len(images) > 2:
        from .incremental import check_pycolmap

        check_pycolmap(len(images))
    skipped_lines: list[str] = []
    usable = _load_all(images, focal, skipped_lines, {} if decoded is None else decoded)
    if skipped_lines and skipped is None:
        raise InputError(skipped_lines[0])
    if len(usable) < 2:
        why = f" that can be used ({skipped_lines[0]})" if skipped_lines else " given"
        raise InputError(f"--cameras estimate: {len(usable)} image{why}, expected two at least; add images")
    if skipped is not None:
        skipped += skipped_lines
    if len(usable) > 2:
        from .incremental import run_incremental_sfm

        return _in_unit(*run_incremental_sfm(usable, refine_focal=focal is None))
    with working("finding the cameras"):
        return _in_unit(*_two_cameras(*usable))


def describe_estimate(images: int, cameras: Sequence[Camera]) -> str:
    """A line that says how the cameras of `images` images were estimated, and what their unit is."""
    by = "OpenCV" if images == 2 else "COLMAP's mapper"
    left = f", {images - len(cameras)} not registered" if len(cameras) < images else ""
    return (
        f"cameras of {len(cameras)} images estimated by {by}{left}; the first is the world's origin, and the unit "
        f"is the median depth of what they see, since images do not know their scale; {_focal_lengths(cameras)}"
    )


def _load_all(
    paths: Sequence[Path], focal: str | None, skipped: list[str], decoded: dict[Path, np.ndarray]
) -> list[UncalibratedImage]:
    """The images with their features, without those that are damaged or the same as another one."""
    loaded: list[UncalibratedImage] = []
    seen: dict[bytes, Path] = {}
    memory = 0
    for image_path in progress(paths, "finding features"):
        try:
            image = load_image(image_path)
        except DamagedImage as error:
            skipped.append(f"{error}; left out")
            continue
        same = seen.setdefault(hashlib.blake2b(image.data).digest(), image_path)
        if same is not image_path:
            skipped.append(f"{image_path}: is the same image as {same}; left out")
            continue
        memory += image.nbytes
        if memory <= DECODED_BYTES:
            decoded[image_path] = image
        loaded.append(_extract(image_path, image, focal))
    return loaded


def _extract(image_path: Path, image: np.ndarray, focal: str | None) -> UncalibratedImage:
    height, width = image.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    small_size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA)
    features = extract_features(small)
    keypoints = features.keypoints * (width / small.shape[1], height / small.shape[0])
    known = exif_focal(image_path, width, height) if focal is None else parse_focal(focal, width, height)
    return UncalibratedImage(image_path, width, height, Features(keypoints, features.descriptors), known)


def _two_cameras(first: UncalibratedImage, second: UncalibratedImage) -> tuple[list[Camera], np.ndarray]:
    """The cameras of two images, and the depths of what both see."""
    Ks = [_pinhole(image) for image in (first, second)]
    pair = f"{first.path} and {second.path}"
    matches = match_features(first.features, second.features)
    if len(matches) < FEWEST_MATCHES:
        raise InputError(
            f"{pair}: {len(matches)} points found in both, expected {FEWEST_MATCHES} at least; "
            "give images that show more of the same, sharp and with texture"
        )
    first_rays = normalize_points(first.features.keypoints[matches[:, 0]], Ks[0])
    second_rays = normalize_points(second.features.keypoints[matches[:, 1]], Ks[1])
    tolerance = float(np.mean([_tolerance(*seen) for seen in zip((first, second), Ks, strict=True)]))
    if rotation_only_inlier_ratio(first_rays, second_rays, tolerance) > MOST_BY_TURNING:
        raise _same_place(pair, 0.0)
    found = _checked(estimate_relative_pose(first_rays, second_rays, tolerance), pair, len(matches))
    extrinsics = invert_rigid(found.second_from_first)
    depths = found.points[:, 2], found.points @ found.second_from_first[2, :3] + found.second_from_first[2, 3]
    cameras = [
        Camera(str(image.path), image.width, image.height, K, pose, depth_range=depth_bounds(depth))
        for image, K, pose, depth in zip((first, second), Ks, (np.eye(4), extrinsics), depths, strict=True)
    ]
    return cameras, np.concatenate(depths)


def _tolerance(image: UncalibratedImage, K: np.ndarray) -> float:
    """How far from its epipolar line a match may lie in this image, on the plane z = 1."""
    working_pixel = max(1.0, max(image.width, image.height) / LONGEST_SIDE)
    return PIXELS_OFF * working_pixel / float(K[0, 0])


def _pinhole(image: UncalibratedImage) -> np.ndarray:
    """K [3, 3] with the axis in the middle; raises InputError where the focal length is not known, or absurd."""
    if image.focal is None:
        raise InputError(
            f"{image.path}: its EXIF data tells no focal length; give --focal, in pixels or as on 35 mm film "
            "(a phone's main camera is about 26mm)"
        )
    K = intrinsic_matrix(image.focal, image.focal, image.width / 2, image.height / 2)
    with error_context(str(image.path)):
        check_intrinsics(K, image.width, image.height)
    return K


def _checked(found: TwoViewGeometry | None, pair: str, matches: int) -> TwoViewGeometry:
    """The relative pose; raises InputError where it rests on too little."""
    inliers = 0 if found is None else int(found.inliers.sum())
    if found is None or inliers < max(FEWEST_MATCHES, matches * LEAST_SHARE):
        raise InputError(
            f"{pair}: {inliers} of {matches} points found in both fit one scene that does not move, expected "
            f"{max(FEWEST_MATCHES, round(matches * LEAST_SHARE))} at least; check --focal, or give other images"
        )
    if found.parallax_deg < LEAST_PARALLAX_DEG:
        raise _same_place(pair, found.parallax_deg)
    return found


def _same_place(pair: str, parallax_deg: float) -> InputError:
    return InputError(
        f"{pair}: were taken from too nearly the same place: sights of the same point are {parallax_deg:.2g} degrees "
        f"apart, expected {LEAST_PARALLAX_DEG} at least; step aside by a twentieth of the scene's distance"
    )


def _in_unit(cameras: Sequence[Camera], depths: np.ndarray) -> list[Camera]:
    """The cameras in the first one's frame, in the unit in which the median of `depths` is 1."""
    scale = 1 / float(np.median(depths))
    to_first = invert_rigid(cameras[0].extrinsics)
    moved = []
    for camera in cameras:
        extrinsics = to_first @ camera.extrinsics
        extrinsics[:3, 3] *= scale
        depth_range = camera.depth_range and (camera.depth_range[0] * scale, camera.depth_range[1] * scale)
        moved.append(replace(camera, extrinsics=extrinsics, depth_range=depth_range))
    return moved


def _focal_lengths(cameras: Sequence[Camera]) -> str:
    focals = sorted(float(camera.K[0, 0]) for camera in cameras)
    span = dict.fromkeys(f"{focal:.0f}" for focal in (focals[0], focals[-1]))
    first = cameras[0]
    return f"focal length {' to '.join(span)} pixels, of images {first.width} wide and {first.height} high"
