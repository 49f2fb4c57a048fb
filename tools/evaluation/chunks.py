"""The released datasets (RealEstate10K, ACID, DL3DV) in the storage format and evaluation protocol of pixelSplat.

A `.torch` chunk is a list of scenes, each a dict of

    key        the scene's name, which the evaluation index uses
    cameras    float [frames, 18]: fx fy cx cy by width and height, two zeros, world-to-camera 3x4 in OpenCV axes
    images     one uint8 tensor a frame, the bytes of a JPEG (RealEstate10K and ACID 640x360, DL3DV 480x270)

and `url` and `timestamps`, which are ignored. The evaluation index is a JSON object by scene name, of null, which
leaves the scene out, or of frame numbers: {"context": [58, 133], "target": [84, 102, 129]}.
"""

import io
import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...runtime.errors import InputError, error_context
from ...runtime.geometry.intrinsics import check_intrinsics, denormalize_intrinsics, intrinsic_matrix
from ...runtime.geometry.rigid import invert_rigid
from ...runtime.images.resizing import cover_crop, resize_and_crop
from ...runtime.system.files import check_regular, read_bytes
from .cases import EvalCase, PosedImages

CAMERA_NUMBERS = 18
FIRST_POSE_NUMBER = 6
# Times near: the near plane of the releases' renderer.
NEAR_PLANE_FACTOR = 0.2
FLOATS = (np.float32, np.float64)
PLAIN = "dense tensor in memory without gradient, of a type that NumPy has"
INSTALL = "pip install 'idesplat[eval]'"


@dataclass(frozen=True)
class IndexEntry:
    """A scene of the evaluation index: frame numbers of context and target views."""

    context: list[int]
    target: list[int]


def read_index(path: Path) -> dict[str, IndexEntry]:
    """The scenes of a published evaluation index that are not null; raises InputError if it is none, or has none."""
    try:
        content = json.loads(read_bytes(path, "an evaluation index"))
    except InputError:
        raise
    except RecursionError:
        raise InputError(f"{path}: is JSON nested too deeply; expected an evaluation index") from None
    except ValueError as error:
        raise InputError(f"{path}: is not valid JSON ({error}); expected an evaluation index") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, expected an object of scenes")
    if content and all(isinstance(value, str) for value in content.values()):
        raise InputError(
            f"{path}: lists chunk files; expected an evaluation index, such as evaluation_index_re10k.json"
        )
    index = {key: _entry(value, f"{path}: {key}") for key, value in content.items() if value is not None}
    if not index:
        raise InputError(f"{path}: names no scene to evaluate; expected an evaluation index")
    return index


def find_chunks(folder: Path) -> list[Path]:
    """The `.torch` files of a folder, in order; raises InputError if there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds the .torch chunks")
    found = sorted(folder.glob("*.torch"))
    if not found:
        inside = sorted({path.parent for path in folder.glob("*/*.torch")})
        instead = f", such as {inside[0]}" if inside else ""
        raise InputError(f"{folder}: no .torch chunks in this folder; give the one that holds them{instead}")
    return found


def read_chunk(path: Path) -> list[dict[str, Any]]:
    """The scenes of a chunk; only data is loaded, code in the file never runs.

    Types and shapes are checked, contents of images and poses are not. Raises InputError for anything else.
    """
    if find_spec("torch") is None:
        raise InputError(f"{path}: PyTorch is needed to read chunks, and is not installed; {INSTALL}")
    import torch

    from ...model.checkpoint import CheckpointError, check_archive

    check_regular(path)
    try:
        check_archive(path)
    except CheckpointError as error:
        raise InputError(str(error)) from None
    try:
        with warnings.catch_warnings(action="ignore"):  # torch warns before it raises
            scenes = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for damaged files
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"{path}: is damaged or holds more than data ({reason}); download it again") from None
    if not isinstance(scenes, list) or not all(isinstance(scene, dict) for scene in scenes):
        raise InputError(f"{path}: holds a {type(scenes).__name__}, expected a list of scenes (dicts)")
    for number, scene in enumerate(scenes):
        _check_scene(scene, f"{path}: scene {number}")
    return scenes


def chunk_cases(
    chunks: list[Path],
    index: dict[str, IndexEntry],
    size: tuple[int, int],
    depth_range: tuple[float, float],
    skip: Callable[[str, str], None],
) -> Iterator[EvalCase]:
    """The indexed scenes of the chunks, in their order, prepared as in the papers.

    size: height and width. depth_range: near and far, the same for all scenes. skip: receives the names of scenes with
    a damaged image or an invalid pose, which are left out as in the releases, and why. Raises InputError as
    `read_chunk` does, and for frame numbers that a scene lacks.
    """
    for path in chunks:
        for scene in read_chunk(path):
            entry = index.get(scene["key"])
            if entry is None:
                continue
            last = max(*entry.context, *entry.target)
            if last >= len(scene["images"]):
                raise InputError(
                    f"{path}: scene {scene['key']} has {len(scene['images'])} frames and the index asks for number "
                    f"{last}; give the index that was made for this dataset"
                )
            try:
                context, targets = (_posed(scene, frames, *size) for frames in (entry.context, entry.target))
            except InputError as error:
                skip(scene["key"], str(error))
                continue
            yield EvalCase(scene["key"], context, targets, *depth_range)


def _entry(value: object, where: str) -> IndexEntry:
    if isinstance(value, dict) and _are_frames(value.get("context")) and _are_frames(value.get("target")):
        return IndexEntry(value["context"], value["target"])
    raise InputError(f'{where}: expected null, or {{"context": [...], "target": [...]}} with numbers of frames')


def _are_frames(value: object) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(type(x) is int and x >= 0 for x in value)


def _check_scene(scene: dict[str, Any], where: str) -> None:
    """Raise InputError unless a scene has its fields, each of the right type and shape."""
    key, images = scene.get("key"), scene.get("images")
    if not isinstance(key, str) or Path(key).name != key:
        raise InputError(f"{where}: key is {key!r:.60}, expected the scene's name")
    cameras = _array(scene.get("cameras"))
    if cameras is None or cameras.dtype not in FLOATS or cameras.ndim != 2 or cameras.shape[1] != CAMERA_NUMBERS:
        found = f"no {PLAIN}" if cameras is None else f"{cameras.dtype} {list(cameras.shape)}"
        raise InputError(f"{where} ({key}): cameras is {found}, expected float32 or float64 [frames, {CAMERA_NUMBERS}]")
    if not isinstance(images, list) or len(images) != len(cameras):
        count = len(images) if isinstance(images, list) else type(images).__name__
        raise InputError(f"{where} ({key}): images is {count}, expected one for each of {len(cameras)} cameras")
    for number, image in enumerate(map(_array, images)):
        # Of others, such as a byte that is said to repeat, a file of any size may hold more than fits into memory.
        if image is None or image.dtype != np.uint8 or image.ndim != 1 or not image.flags.c_contiguous:
            raise InputError(
                f"{where} ({key}): images[{number}] is no dense, contiguous uint8 tensor [bytes] of a JPEG file"
            )


def _array(value: object) -> np.ndarray | None:
    """The values of a tensor; None for anything else, and for a tensor that is not `PLAIN`."""
    import torch

    if not isinstance(value, torch.Tensor):
        return None
    try:
        return torch.Tensor.numpy(value)
    except (TypeError, RuntimeError):
        return None


def _posed(scene: dict[str, Any], frames: list[int], height: int, width: int) -> PosedImages:
    images, intrinsics, extrinsics = [], [], []
    for frame in frames:
        with error_context(f"frame {frame}"):
            K, pose = _camera(scene["cameras"][frame].numpy().astype(np.float64))
            image, k = _fitted(_decoded(scene["images"][frame].numpy()), K, height, width)
        images.append(image)
        intrinsics.append(k)
        extrinsics.append(pose)
    names = [str(frame) for frame in frames]
    valid = np.ones((len(frames), height, width), bool)
    return PosedImages(names, np.stack(images), np.stack(extrinsics), np.stack(intrinsics), valid)


def _camera(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalised intrinsics [3, 3] and camera-to-world pose [4, 4] of a row of `cameras` [18]."""
    fx, fy, cx, cy = numbers[:4]
    intrinsics = intrinsic_matrix(fx, fy, cx, cy)
    check_intrinsics(intrinsics, 1, 1)
    world_to_camera = np.vstack([numbers[FIRST_POSE_NUMBER:].reshape(3, 4), [0, 0, 0, 1]])
    return intrinsics, invert_rigid(world_to_camera)


def _decoded(content: np.ndarray) -> np.ndarray:
    """Decode the bytes of a JPEG file: RGB [height, width, 3], uint8."""
    try:
        with Image.open(io.BytesIO(content.tobytes())) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"the image cannot be decoded ({error})") from None


def _fitted(image: np.ndarray, K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The image scaled and cropped to height x width, float32 [3, height, width], with normalised intrinsics [3, 3].

    The papers scale with Pillow's Lanczos filter, not with that of `resize_and_crop`. On three views of real images the
    difference lowered the PSNR of a warped plane by 0.3 to 0.6 dB.
    """
    full_height, full_width = image.shape[:2]
    crop = cover_crop(full_width, full_height, width, height)
    scaled = Image.fromarray(image).resize((crop.width, crop.height), Image.Resampling.LANCZOS)
    K_scaled = denormalize_intrinsics(K, crop.width, crop.height)
    middle = cover_crop(crop.width, crop.height, width, height)
    return resize_and_crop(np.asarray(scaled), K_scaled, height, width, middle)
