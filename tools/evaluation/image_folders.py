"""Evaluation cases from a folder of images with cameras: held-out images, and context views around each."""

import hashlib
import math
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ...runtime.cameras.camera import Camera, resize_camera
from ...runtime.cameras.undistortion import undistortion_valid_mask
from ...runtime.errors import InputError
from ...runtime.images.header import image_size
from ...runtime.images.io import load_image
from ...runtime.images.resizing import frame_crop
from ...runtime.system.files import check_regular
from ...runtime.views.batch import ViewBatch, build_view_batch
from ...runtime.views.depth_range import DepthRange
from .cases import EvalCase, PosedImages

Frame = tuple[Path, Camera]

# A camera whose viewing direction differs by this angle counts as twice as far away.
ANGLE_DEG = 30.0
# Images that were undistorted before have black borders; JPEG makes them nearly black, in blocks of 8 pixels.
BLACK, JPEG_BLOCK = 8, 8
# Pixels at the network's size that are left out around invalid ones.
MARGIN = 2
DEPTH = "depth"  # in an .npz of true depth
NPY_HEADER_BYTES, MAX_BYTES_PER_DEPTH = 1 << 16, 16
MIN_VALID = 0.1  # of a image's pixels
MAX_NAME_BYTES = 100  # of a case's name, to which strips add a target's; file names have 255 at most
MAX_STEM_BYTES = 36
HASH_DIGITS = 8


def split_frames(
    frames: Sequence[Frame], context: Sequence[str], targets: Sequence[str], views: int, hold_out_every: int
) -> list[tuple[list[int], list[int]]]:
    """Split frames into context and held-out targets: pairs of lists of frame numbers.

    context, targets: file names, with suffix or without. Without targets, one of every `hold_out_every` frames is held
    out, from the first one; without a context, each target gets the `views` frames around it that are not held out.
    Raises InputError for names of no frame or of several, for names given twice, and for too few frames or views.
    """
    given = [_number(frames, name, "--context") for name in context]
    held_out = [_number(frames, name, "--hold-out") for name in targets]
    for number in {*given, *held_out}:
        if [*given, *held_out].count(number) > 1:
            raise InputError(f"{frames[number][0].name} is named twice, expected each frame once, as context or target")
    if given and not held_out:
        raise InputError("--context without --hold-out; name the frames to compare with")
    if given:
        if len(given) < 2:
            raise InputError(f"--context names {len(given)} frame, expected at least 2")
        return [(given, held_out)]
    if views < 2:
        raise InputError(f"--views {views}: expected at least 2 images around each target")
    held_out = held_out or list(range(0, len(frames), hold_out_every))
    rest = [number for number in range(len(frames)) if number not in held_out]
    if len(rest) < views:
        raise InputError(
            f"{len(frames)} images, of which {len(held_out)} are held out: too few are left for a context of {views}"
        )
    poses = np.stack([camera.extrinsics for _, camera in frames])
    by_context: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for target in held_out:
        by_context[tuple(context_for(poses, target, rest, views))].append(target)
    return [(list(key), group) for key, group in by_context.items()]


def context_for(extrinsics: np.ndarray, target: int, rest: Sequence[int], count: int) -> list[int]:
    """The `count` cameras among `rest` around a target: the nearest, the nearest on its other side, the next nearest.

    extrinsics: all cameras' poses, [cameras, 4, 4]. The distance grows with the angle between viewing directions.
    """
    offset = extrinsics[:, :3, 3] - extrinsics[target, :3, 3]  # [cameras, 3]
    angle = np.degrees(np.arccos(np.clip(extrinsics[:, :3, 2] @ extrinsics[target, :3, 2], -1, 1)))
    distance = np.linalg.norm(offset, axis=1) * (1 + (angle / ANGLE_DEG) ** 2)
    nearest, *others = sorted(rest, key=lambda camera: distance[camera])
    others.sort(key=lambda camera: bool(offset[camera] @ offset[nearest] > 0))  # stable: by distance on either side
    second, *others = others
    others.sort(key=lambda camera: distance[camera])
    return sorted([nearest, second, *others[: count - 2]])


def load_case(
    frames: Sequence[Frame],
    context: Sequence[int],
    targets: Sequence[int],
    size: tuple[int, int],
    find_range: Callable[[ViewBatch], DepthRange],
    depth: Path | None = None,
) -> EvalCase:
    """The frames undistorted, resized and cropped to the network's size, with masks of valid pixels.

    size: height and width. find_range: finds near and far from the context views.
    depth: a folder of true z-depth with an .npz for each context frame, named like it, that holds `depth`
    [height, width] at the image's own size. Raises InputError for images, cameras and depth that cannot be used.
    """
    chosen = [frames[number] for number in (*context, *targets)]
    views = build_view_batch(chosen, None, *size)
    valid = np.stack([valid_pixels(load_image(path), camera, *size) for path, camera in chosen])
    for name, seen in zip(views.names, valid, strict=True):
        if seen.mean() < MIN_VALID:
            raise InputError(f"{name}: is black nearly everywhere, or its distortion wrong; expected an image")

    def taken(part: slice) -> ViewBatch:
        images, extrinsics, intrinsics = (field[part] for field in (views.images, views.extrinsics, views.intrinsics))
        samples = views.feature_images[part]
        return ViewBatch(views.names[part], images, extrinsics, intrinsics, views.cameras[part], feature_images=samples)

    def posed(part: ViewBatch, valid: np.ndarray) -> PosedImages:
        return PosedImages(part.names, part.images, part.extrinsics, part.intrinsics, valid)

    count = len(context)
    given, held_out = taken(slice(count)), taken(slice(count, None))
    found = find_range(given)
    truth = None if depth is None else np.stack([_fitted_depth(depth, *frame, *size) for frame in chosen[:count]])
    return EvalCase(
        _case_name([path.stem for path, _ in chosen[:count]]),
        posed(given, valid[:count]),
        posed(held_out, valid[count:]),
        found.near,
        found.far,
        truth,
    )


def _case_name(stems: Sequence[str]) -> str:
    """The stems of the context's images with + between; of many or long ones the first, the last, a count and a hash.

    Files are named after it.
    """
    name = "+".join(stems)
    encoded = os.fsencode(name)
    if len(encoded) <= MAX_NAME_BYTES:
        return name
    first, last = (os.fsencode(stem)[:MAX_STEM_BYTES].decode(errors="ignore") for stem in (stems[0], stems[-1]))
    return f"{first}+{last}-{len(stems)}-{hashlib.sha256(encoded).hexdigest()[:HASH_DIGITS]}"


def _number(frames: Sequence[Frame], name: str, option: str) -> int:
    """The number of the frame with this name."""
    found = [number for number, (path, _) in enumerate(frames) if name in (path.name, path.stem)]
    if len(found) == 1:
        return found[0]
    examples = ", ".join(path.name for path, _ in frames[:3])
    count = "several" if found else "none"
    raise InputError(f"{option} {name}: the name of {count} of {len(frames)} images; they are {examples}, ...")


def valid_pixels(image: np.ndarray, camera: Camera, height: int, width: int) -> np.ndarray:
    """Mask of the pixels of an image [h, w, 3], undistorted and resized to height x width, that hold data."""
    if camera.distortion is None:
        seen = ~_black_border(image)
    else:
        seen = undistortion_valid_mask(resize_camera(camera, image.shape[1], image.shape[0]))
    crop = frame_crop(image.shape[1], image.shape[0], width, height)
    interpolation = cv2.INTER_AREA if crop.scale_x < 1 else cv2.INTER_LINEAR
    share = cv2.resize(seen.astype(np.float32), (crop.width, crop.height), interpolation=interpolation)
    whole = (share[crop.top : crop.top + height, crop.left : crop.left + width] > 0.999).astype(np.uint8)
    return cv2.erode(whole, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)).astype(bool)


def _black_border(image: np.ndarray) -> np.ndarray:
    """The black regions of an image [height, width, 3] that reach its border, bool [height, width]."""
    dark = (image.max(axis=2) <= BLACK).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    edges = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    black = np.isin(labels, edges[edges > 0]).astype(np.uint8)
    return cv2.dilate(black, np.ones((2 * JPEG_BLOCK + 1, 2 * JPEG_BLOCK + 1), np.uint8)).astype(bool)


def _fitted_depth(folder: Path, path: Path, camera: Camera, height: int, width: int) -> np.ndarray:
    """True depth of an image at the pixels of its resized and cropped version, [height, width]; nearest neighbour."""
    if camera.distortion is not None:
        raise InputError(f"{path}: has lens distortion; true depth can only be compared for undistorted images")
    depth = _read_depth(folder / f"{path.stem}.npz", path)
    crop = frame_crop(depth.shape[1], depth.shape[0], width, height)
    rows = np.floor((np.arange(height) + 0.5 + crop.top) / crop.scale_y).astype(int)
    columns = np.floor((np.arange(width) + 0.5 + crop.left) / crop.scale_x).astype(int)
    return depth[rows][:, columns]


def _read_depth(file: Path, image: Path) -> np.ndarray:
    """Depth in an .npz file, of the image's size; raises InputError for anything else."""
    shape = image_size(image)[::-1]
    most = NPY_HEADER_BYTES + MAX_BYTES_PER_DEPTH * math.prod(shape)
    try:
        check_regular(file)
        with np.load(file) as content:
            if content.zip.getinfo(f"{DEPTH}.npy").file_size > most:
                raise InputError(f"{file}: holds more than depth of shape {shape}, the size of {image.name}")
            depth = content[DEPTH]
    except InputError:
        raise
    except Exception as error:  # Python, zlib and NumPy raise many types for damaged archives
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{file}: no readable depth ({reason}); expected what make_scene writes") from None
    if depth.dtype.kind not in "fiu":
        raise InputError(f"{file}: depth of type {depth.dtype}, expected numbers")
    if depth.shape != shape:
        raise InputError(f"{file}: depth of shape {depth.shape}, expected {shape}, the size of {image.name}")
    return depth
