"""Photographs without cameras: what `--cameras estimate` does.

Two photographs take OpenCV: SIFT, the essential matrix, triangulation; their lenses are taken to have no distortion and
their axis in the middle of the picture. More take COLMAP's mapper. The world is the first photograph's camera, and its
unit the median depth of the points that were found, since photographs know no unit.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError, located
from ..geometry.depth_bounds import range_of_depths
from ..geometry.intrinsics import calibration, check_intrinsics
from ..geometry.rigid import invert_rigid
from ..images.exif import exif_focal, given_focal
from ..images.header import DamagedImage
from ..images.io import load_image
from ..system.progress import progress, working
from .features import Features, find_features, match_features, rays_of
from .two_view import TwoViews, estimate_pose, explained_by_turning

DECODED_BYTES = 1 << 29  # of images that are kept, so that those that are chosen later need not be read again
LONGEST_SIDE = 1600  # pixels, in which features are looked for
PIXELS_OFF = 1.5  # at that size: how far from its epipolar line a match may lie
FEWEST_MATCHES = 40
MOST_BY_TURNING = 0.7  # of the matches may be explained by a camera that only turned
LEAST_SHARE = 0.3  # of the matches must agree
LEAST_PARALLAX_DEG = 1.5  # below, the direction from one camera to the other is mostly noise


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph before its camera is known. features: in pixels of its own size; focal: pixels, if known."""

    path: Path
    width: int
    height: int
    features: Features
    focal: float | None


def estimate_cameras(
    pictures: Sequence[Path],
    focal: str | None = None,
    left_out: list[str] | None = None,
    decoded: dict[Path, np.ndarray] | None = None,
) -> list[Camera]:
    """Cameras for photographs of one scene that does not move; of more than two, those that could be placed.

    focal: the focal length of all, in pixels (`1375`) or on 35 mm film (`26mm`); else each one's EXIF data tells, and
    with more than two photographs it is found where neither does.
    left_out: receives a line for each photograph that is damaged or the same as another one, and is left out; where it
    is None, that is an error. decoded: receives the photographs as they were read, up to DECODED_BYTES.
    The first camera is the world's origin, the median depth of what is seen is 1, and `depth_range` is set.
    Raises InputError for fewer than two photographs, two without focal length, too few common points, too little
    parallax, more than two photographs without pycolmap, or where nothing fits together.
    """
    if len(pictures) > 2:
        from .incremental import check_mapper

        check_mapper(len(pictures))
    left_out_lines: list[str] = []
    photographs = _see_all(pictures, focal, left_out_lines, {} if decoded is None else decoded)
    if left_out_lines and left_out is None:
        raise InputError(left_out_lines[0])
    if len(photographs) < 2:
        why = f" that can be used ({left_out_lines[0]})" if left_out_lines else " given"
        raise InputError(
            f"--cameras estimate: {len(photographs)} photograph{why}, expected two at least; add photographs"
        )
    if left_out is not None:
        left_out += left_out_lines
    if len(photographs) > 2:
        from .incremental import place_photographs

        return _in_unit(*place_photographs(photographs, refine_focal=focal is None))
    with working("finding the cameras"):
        return _in_unit(*_two_cameras(*photographs))


def _see_all(
    pictures: Sequence[Path], focal: str | None, left_out: list[str], decoded: dict[Path, np.ndarray]
) -> list[Photograph]:
    """The photographs with their features, without those that are damaged or the same as another one."""
    photographs: list[Photograph] = []
    seen: dict[bytes, Path] = {}
    memory = 0
    for picture in progress(pictures, "finding features"):
        try:
            image = load_image(picture)
        except DamagedImage as error:
            left_out.append(f"{error}; left out")
            continue
        same = seen.setdefault(hashlib.blake2b(image.data).digest(), picture)
        if same is not picture:
            left_out.append(f"{picture}: is the same image as {same}; left out")
            continue
        memory += image.nbytes
        if memory <= DECODED_BYTES:
            decoded[picture] = image
        photographs.append(_see(picture, image, focal))
    return photographs


def _see(picture: Path, image: np.ndarray, focal: str | None) -> Photograph:
    height, width = image.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    small_size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA)
    features = find_features(small)
    places = features.places * (width / small.shape[1], height / small.shape[0])
    known = exif_focal(picture, width, height) if focal is None else given_focal(focal, width, height)
    return Photograph(picture, width, height, Features(places, features.descriptors), known)


def _two_cameras(first: Photograph, second: Photograph) -> tuple[list[Camera], np.ndarray]:
    """The cameras of two photographs, and the depths of what both see."""
    Ks = [_pinhole(photograph) for photograph in (first, second)]
    pair = f"{first.path} and {second.path}"
    matches = match_features(first.features, second.features)
    if len(matches) < FEWEST_MATCHES:
        raise InputError(
            f"{pair}: {len(matches)} points found in both, expected {FEWEST_MATCHES} at least; "
            "give photographs that show more of the same, sharp and with texture"
        )
    first_rays = rays_of(first.features.places[matches[:, 0]], Ks[0])
    second_rays = rays_of(second.features.places[matches[:, 1]], Ks[1])
    tolerance = float(np.mean([_tolerance(*seen) for seen in zip((first, second), Ks, strict=True)]))
    if explained_by_turning(first_rays, second_rays, tolerance) > MOST_BY_TURNING:
        raise _same_place(pair, 0.0)
    found = _checked(estimate_pose(first_rays, second_rays, tolerance), pair, len(matches))
    extrinsics = invert_rigid(found.second_from_first)
    depths = found.points[:, 2], found.points @ found.second_from_first[2, :3] + found.second_from_first[2, 3]
    cameras = [
        Camera(str(photograph.path), photograph.width, photograph.height, K, pose, depth_range=range_of_depths(depth))
        for photograph, K, pose, depth in zip((first, second), Ks, (np.eye(4), extrinsics), depths, strict=True)
    ]
    return cameras, np.concatenate(depths)


def _tolerance(photograph: Photograph, K: np.ndarray) -> float:
    """How far from its epipolar line a match may lie in this photograph, on the plane z = 1."""
    working_pixel = max(1.0, max(photograph.width, photograph.height) / LONGEST_SIDE)
    return PIXELS_OFF * working_pixel / float(K[0, 0])


def _pinhole(photograph: Photograph) -> np.ndarray:
    """K [3, 3] with the axis in the middle; raises InputError where the focal length is not known, or absurd."""
    if photograph.focal is None:
        raise InputError(
            f"{photograph.path}: its EXIF data tells no focal length; give --focal, in pixels or as on 35 mm film "
            "(a phone's main camera is about 26mm)"
        )
    K = calibration(photograph.focal, photograph.focal, photograph.width / 2, photograph.height / 2)
    with located(str(photograph.path)):
        check_intrinsics(K, photograph.width, photograph.height)
    return K


def _checked(found: TwoViews | None, pair: str, matches: int) -> TwoViews:
    """The relative pose; raises InputError where it rests on too little."""
    fits = 0 if found is None else int(found.fits.sum())
    if found is None or fits < max(FEWEST_MATCHES, matches * LEAST_SHARE):
        raise InputError(
            f"{pair}: {fits} of {matches} points found in both fit one scene that does not move, expected "
            f"{max(FEWEST_MATCHES, round(matches * LEAST_SHARE))} at least; check --focal, or give other photographs"
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
