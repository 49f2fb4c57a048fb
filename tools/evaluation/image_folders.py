"""Cases from a folder of images: some are held out, and for each of those a context is chosen among the rest."""

import math
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
from ...runtime.images.resizing import cover_crop
from ...runtime.system.files import check_regular
from ...runtime.views.batch import ViewBatch, build_view_batch
from ...runtime.views.depth_range import DepthRange
from .cases import EvalCase, PosedImages

Frame = tuple[Path, Camera]

# A camera that looks this much elsewhere counts as standing twice as far away.
TURN_DEG = 30.0
# Images that somebody undistorted have black borders, which JPEG makes nearly black, in blocks of 8 pixels.
BLACK, JPEG_BLOCK = 8, 8
# Pixels at the network's size that are left out beside what the camera did not see.
MARGIN = 2
DEPTH = "depth"  # in an .npz of true depth
NPY_HEADER_BYTES, MOST_BYTES_A_DEPTH = 1 << 16, 16
LEAST_VALID = 0.1  # of a image's pixels


def split_frames(
    frames: Sequence[Frame], context: Sequence[str], targets: Sequence[str], views: int, hold_out_every: int
) -> list[tuple[list[int], list[int]]]:
    """Which frames a network is given and which it is to meet: pairs of context and targets, as numbers of frames.

    context, targets: file names, with suffix or without. Without targets, one of every `hold_out_every` frames is
    held out, from the first one; without a context, each target gets `views` frames of its own from those that are not
    held out.
    Raises InputError for names that no frame or several have, that are given twice, and for too few frames.
    """
    given = [_number(frames, name, "--context") for name in context]
    wanted = [_number(frames, name, "--target") for name in targets]
    for number in {*given, *wanted}:
        if [*given, *wanted].count(number) > 1:
            raise InputError(f"{frames[number][0].name} is named twice, expected each frame once, as context or target")
    if given and not wanted:
        raise InputError("--context without --target; name the frames to compare with")
    if given:
        if len(given) < 2:
            raise InputError(f"--context names {len(given)} frame, expected at least 2")
        return [(given, wanted)]
    wanted = wanted or list(range(0, len(frames), hold_out_every))
    rest = [number for number in range(len(frames)) if number not in wanted]
    if len(rest) < views:
        raise InputError(
            f"{len(frames)} images, of which {len(wanted)} are held out: too few are left for a context of {views}"
        )
    poses = np.stack([camera.extrinsics for _, camera in frames])
    together: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for target in wanted:
        together[tuple(context_for(poses, target, rest, views))].append(target)
    return [(list(key), group) for key, group in together.items()]


def context_for(extrinsics: np.ndarray, target: int, rest: Sequence[int], count: int) -> list[int]:
    """The `count` cameras among `rest` around a target: the nearest, the nearest on its other side, the next nearest.

    extrinsics: all cameras' poses, [cameras, 4, 4]. Cameras that look elsewhere count as farther away.
    """
    away = extrinsics[:, :3, 3] - extrinsics[target, :3, 3]  # [cameras, 3]
    turn = np.degrees(np.arccos(np.clip(extrinsics[:, :3, 2] @ extrinsics[target, :3, 2], -1, 1)))
    distance = np.linalg.norm(away, axis=1) * (1 + (turn / TURN_DEG) ** 2)
    nearest, *others = sorted(rest, key=lambda camera: distance[camera])
    others.sort(key=lambda camera: bool(away[camera] @ away[nearest] > 0))  # stable: by distance on either side
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
    """The frames undistorted, resized and cropped as the network takes them, and which of their pixels are valid.

    size: height and width. find_range: finds near and far from the context views.
    depth: a folder of the context's true z-depth, one .npz for each frame, named like it, with `depth` [height, width]
    at the image's size.
    Raises InputError for images, cameras and depth that cannot be used.
    """
    chosen = [frames[number] for number in (*context, *targets)]
    views = build_view_batch(chosen, None, *size)
    valid = np.stack([valid_pixels(load_image(path), camera, *size) for path, camera in chosen])
    for name, seen in zip(views.names, valid, strict=True):
        if seen.mean() < LEAST_VALID:
            raise InputError(f"{name}: is black nearly everywhere, or its distortion wrong; expected a image")

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
    name = "+".join(path.stem for path, _ in chosen[:count])
    return EvalCase(name, posed(given, valid[:count]), posed(held_out, valid[count:]), found.near, found.far, truth)


def _number(frames: Sequence[Frame], name: str, option: str) -> int:
    """The frame that a name stands for."""
    found = [number for number, (path, _) in enumerate(frames) if name in (path.name, path.stem)]
    if len(found) == 1:
        return found[0]
    examples = ", ".join(path.name for path, _ in frames[:3])
    count = "several" if found else "none"
    raise InputError(f"{option} {name}: the name of {count} of {len(frames)} images; they are {examples}, ...")


def valid_pixels(image: np.ndarray, camera: Camera, height: int, width: int) -> np.ndarray:
    """Where an image [h, w, 3], once brought to height x width, shows what its camera saw, bool [height, width]."""
    if camera.distortion is None:
        seen = ~_black_border(image)
    else:
        seen = undistortion_valid_mask(resize_camera(camera, image.shape[1], image.shape[0]))
    crop = cover_crop(image.shape[1], image.shape[0], width, height)
    interpolation = cv2.INTER_AREA if crop.scale_x < 1 else cv2.INTER_LINEAR
    share = cv2.resize(seen.astype(np.float32), (crop.width, crop.height), interpolation=interpolation)
    whole = (share[crop.top : crop.top + height, crop.left : crop.left + width] > 0.999).astype(np.uint8)
    return cv2.erode(whole, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)).astype(bool)


def _black_border(image: np.ndarray) -> np.ndarray:
    """The black regions of a image [height, width, 3] that reach its border, bool [height, width]."""
    dark = (image.max(axis=2) <= BLACK).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    edges = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    black = np.isin(labels, edges[edges > 0]).astype(np.uint8)
    return cv2.dilate(black, np.ones((2 * JPEG_BLOCK + 1, 2 * JPEG_BLOCK + 1), np.uint8)).astype(bool)


def _fitted_depth(folder: Path, path: Path, camera: Camera, height: int, width: int) -> np.ndarray:
    file = folder / f"{path.stem}.npz"
    if camera.distortion is not None:
        raise InputError(f"{path}: has lens distortion; true depth can only be compared for undistorted images")
    shape = image_size(path)[::-1]
    try:
        check_regular(file)
        with np.load(file) as content:
            if content.zip.getinfo(f"{DEPTH}.npy").file_size > NPY_HEADER_BYTES + MOST_BYTES_A_DEPTH * math.prod(shape):
                raise InputError(f"{file}: holds more than depth of shape {shape}, the size of {path.name}")
            depth = content[DEPTH]
    except InputError:
        raise
    except Exception as error:  # of damaged archives Python, zlib and NumPy raise many kinds
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{file}: no readable depth ({reason}); expected what make_scene writes") from None
    if depth.dtype.kind not in "fiu":
        raise InputError(f"{file}: depth of type {depth.dtype}, expected numbers")
    if depth.shape != shape:
        raise InputError(f"{file}: depth of shape {depth.shape}, expected {shape}, the size of {path.name}")
    crop = cover_crop(shape[1], shape[0], width, height)
    rows = np.floor((np.arange(height) + 0.5 + crop.top) / crop.scale_y).astype(int)
    columns = np.floor((np.arange(width) + 0.5 + crop.left) / crop.scale_x).astype(int)
    return depth[rows][:, columns]
