"""Camera estimation from images alone (`--cameras estimate`).

Two images: relative pose from the essential matrix (see `two_view`), with a pinhole model without distortion and the
principal point at the image centre. More images: COLMAP's incremental mapper (see `incremental`). The world frame is
that of the first camera. Scale cannot be observed: the median depth of the reconstructed points is set to 1.
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
from .incremental import check_pycolmap, run_incremental_sfm
from .two_view import TwoViewGeometry, estimate_relative_pose, rotation_only_inlier_ratio

DECODED_BYTES = 1 << 29  # of decoded images that are kept, so that they need not be read again
MAX_SIDE = 1600  # pixels, in which features are extracted
MAX_EPIPOLAR_ERROR = 1.5  # pixels at that size, of an inlier
MIN_MATCHES = 40
MAX_ROTATION_INLIER_RATIO = 0.7  # more matches that a pure rotation explains mean that there is no baseline
MIN_INLIER_RATIO = 0.3
MIN_PARALLAX_DEG = 1.5  # with less, the direction of the translation is mostly noise


@dataclass(frozen=True, eq=False)
class UncalibratedImage:
    """An image whose camera is not known yet. features: in pixels of the full size. focal: pixels, if known."""

    path: Path
    width: int
    height: int
    features: Features
    focal: float | None


def estimate_cameras(
    images: Sequence[Path],
    focal: str | float | None = None,
    skipped: list[str] | None = None,
    decoded: dict[Path, np.ndarray] | None = None,
) -> list[Camera]:
    """Estimate the cameras of images of one static scene; of more than two images, of those that can be registered.

    focal: the focal length of all images, in pixels (1375 or `1375`) or equivalent to 35 mm film (`26mm`). By default
    it is read from each image's EXIF data, and refined if these are many; with more than two images it is estimated
    where these lack it.
    skipped: receives a line for each damaged or duplicate image, which is then left out; if None, such an image raises.
    decoded: receives the decoded images, up to DECODED_BYTES.
    Returns cameras in the frame of the first one, in a unit in which the median depth is 1, with `depth_range`.
    Raises InputError for fewer than two images, two without focal length, too few matches, too little parallax, more
    than two images without pycolmap, or if no image can be registered.
    """
    if len(images) > 2:
        check_pycolmap(len(images))
    skipped_lines: list[str] = []
    usable = _load_all(images, focal, skipped_lines, {} if decoded is None else decoded)
    if skipped_lines and skipped is None:
        raise InputError(skipped_lines[0])
    if len(usable) < 2:
        why = f" that can be used ({skipped_lines[0]})" if skipped_lines else " given"
        count = "1 image" if usable else "no image"
        raise InputError(f"--cameras estimate: {count}{why}, expected two at least; add images")
    if skipped is not None:
        skipped += skipped_lines
    if len(usable) > 2:
        return _normalized(*run_incremental_sfm(usable, refine_focal=focal is None))
    with working("estimating the cameras"):
        return _normalized(*_two_cameras(*usable))


def describe_estimate(images: int, cameras: Sequence[Camera]) -> str:
    """A line for the user: how the cameras of `images` images were estimated, and in which unit."""
    by = "OpenCV" if images == 2 else "COLMAP's mapper"
    left = f", {images - len(cameras)} not registered" if len(cameras) < images else ""
    return (
        f"cameras of {len(cameras)} images estimated by {by}{left}; the first is the world frame, and the unit "
        f"is the median depth, since images do not determine the scale; {_focal_lengths(cameras)}"
    )


def _load_all(
    paths: Sequence[Path], focal: str | float | None, skipped: list[str], decoded: dict[Path, np.ndarray]
) -> list[UncalibratedImage]:
    """The images with their features, without damaged and duplicate ones."""
    loaded: list[UncalibratedImage] = []
    seen: dict[bytes, Path] = {}
    memory = 0
    for image_path in progress(paths, "extracting features"):
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


def _extract(image_path: Path, image: np.ndarray, focal: str | float | None) -> UncalibratedImage:
    height, width = image.shape[:2]
    scale = min(1.0, MAX_SIDE / max(height, width))
    small_size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA)
    features = extract_features(small)
    keypoints = features.keypoints * (width / small.shape[1], height / small.shape[0])
    known = exif_focal(image_path, width, height) if focal is None else parse_focal(str(focal), width, height)
    return UncalibratedImage(image_path, width, height, Features(keypoints, features.descriptors), known)


def _two_cameras(first: UncalibratedImage, second: UncalibratedImage) -> tuple[list[Camera], np.ndarray]:
    """The cameras of two images, and the depths of their points in both."""
    Ks = [_pinhole(image) for image in (first, second)]
    pair = f"{first.path} and {second.path}"
    matches = match_features(first.features, second.features)
    if len(matches) < MIN_MATCHES:
        raise InputError(
            f"{pair}: {len(matches)} features match, expected {MIN_MATCHES} at least; "
            "give sharp images with texture that overlap more"
        )
    first_points = normalize_points(first.features.keypoints[matches[:, 0]], Ks[0])
    second_points = normalize_points(second.features.keypoints[matches[:, 1]], Ks[1])
    tolerance = float(np.mean([_tolerance(*view) for view in zip((first, second), Ks, strict=True)]))
    if rotation_only_inlier_ratio(first_points, second_points, tolerance) > MAX_ROTATION_INLIER_RATIO:
        raise _same_place(pair, 0.0)
    found = _checked(estimate_relative_pose(first_points, second_points, tolerance), pair, len(matches))
    extrinsics = invert_rigid(found.second_from_first)
    depths = found.points[:, 2], found.points @ found.second_from_first[2, :3] + found.second_from_first[2, 3]
    cameras = [
        Camera(str(image.path), image.width, image.height, K, pose, depth_range=depth_bounds(depth))
        for image, K, pose, depth in zip((first, second), Ks, (np.eye(4), extrinsics), depths, strict=True)
    ]
    return cameras, np.concatenate(depths)


def _tolerance(image: UncalibratedImage, K: np.ndarray) -> float:
    """The maximum epipolar error of an inlier in this image, in normalised image coordinates."""
    pixel = max(1.0, max(image.width, image.height) / MAX_SIDE)  # of the resized image
    return MAX_EPIPOLAR_ERROR * pixel / float(K[0, 0])


def _pinhole(image: UncalibratedImage) -> np.ndarray:
    """K [3, 3] with the principal point at the centre. Raises InputError for an unknown or implausible focal length."""
    if image.focal is None:
        raise InputError(
            f"{image.path}: its EXIF data has no focal length; give --focal, in pixels or equivalent to 35 mm film "
            "(a phone's main camera is about 26mm)"
        )
    K = intrinsic_matrix(image.focal, image.focal, image.width / 2, image.height / 2)
    with error_context(str(image.path)):
        check_intrinsics(K, image.width, image.height)
    return K


def _checked(found: TwoViewGeometry | None, pair: str, matches: int) -> TwoViewGeometry:
    """The relative pose, if it has enough inliers and parallax. Raises InputError otherwise."""
    inliers = 0 if found is None else int(found.inliers.sum())
    if found is None or inliers < max(MIN_MATCHES, matches * MIN_INLIER_RATIO):
        raise InputError(
            f"{pair}: {inliers} of {matches} matches are inliers of a static scene, expected "
            f"{max(MIN_MATCHES, round(matches * MIN_INLIER_RATIO))} at least; check --focal, or give other images"
        )
    if found.parallax_deg < MIN_PARALLAX_DEG:
        raise _same_place(pair, found.parallax_deg)
    return found


def _same_place(pair: str, parallax_deg: float) -> InputError:
    return InputError(
        f"{pair}: were taken from nearly the same place: the parallax is {parallax_deg:.2g} degrees, expected "
        f"{MIN_PARALLAX_DEG} at least; step aside by a twentieth of the distance to the scene"
    )


def _normalized(cameras: Sequence[Camera], depths: np.ndarray) -> list[Camera]:
    """The cameras in the frame of the first one, scaled so that the median of `depths` is 1."""
    scale = 1 / float(np.median(depths))
    to_first = invert_rigid(cameras[0].extrinsics)
    normalized = []
    for camera in cameras:
        extrinsics = to_first @ camera.extrinsics
        extrinsics[:3, 3] *= scale
        depth_range = camera.depth_range and (camera.depth_range[0] * scale, camera.depth_range[1] * scale)
        normalized.append(replace(camera, extrinsics=extrinsics, depth_range=depth_range))
    return normalized


def _focal_lengths(cameras: Sequence[Camera]) -> str:
    focals = sorted(float(camera.K[0, 0]) for camera in cameras)
    span = dict.fromkeys(f"{focal:.0f}" for focal in (focals[0], focals[-1]))
    first = cameras[0]
    return f"focal length {' to '.join(span)} pixels, of images {first.width} wide and {first.height} high"
