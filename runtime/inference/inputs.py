"""What idesplat-infer is given, brought together: photographs or a video, their cameras or none, views and size."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..cameras.formats import ESTIMATE, CameraFormat
from ..cameras.io import read_cameras
from ..errors import InputError
from ..images.io import describe_unsupported, image_stem
from ..images.resizing import cover_crop
from ..images.sizes import nearest_size, parse_size
from ..system.files import scratch_folder
from ..system.progress import working
from ..views.batch import ViewBatch, build_view_batch, match_images_to_cameras
from ..views.loader import ImageCameraPair
from ..views.selection import MIN_VIEWS
from ..views.sources import find_input_images
from .model_files import ModelFiles

DEFAULT_VIEWS = 2
# What --frames takes beside names and numbers: 0-3 is 0, 1, 2, 3; 0:8:2 is 0, 2, 4, 6, as Python has it.
RANGE = re.compile(r"([0-9]{1,9})(?:-([0-9]{1,9}))?")
SLICE = re.compile(r"([0-9]{0,9}):([0-9]{0,9})(?::([0-9]{0,9}))?")
MUCH = 0.7  # share of a photograph below which it is said that the rest is cut off


@dataclass(frozen=True)
class Request:
    """What the user asked for, in the words of the options."""

    images: list[Path]
    cameras: str
    camera_format: CameraFormat | None
    focal: str | None
    frames: str | None
    views: int | None
    size: str | None


@dataclass(frozen=True, eq=False)
class Inputs:
    """What the network takes, and how it came about.

    views: the chosen photographs with their cameras. photographs: the files of all, chosen or not. cameras: those of
    all photographs. notes: lines for the user.
    """

    views: ViewBatch
    photographs: list[Path]
    cameras: list[Camera]
    notes: list[str]


def read_inputs(request: Request, model: ModelFiles) -> Inputs:
    """Read photographs and cameras, or estimate these, choose the views and bring them to the model's size.

    Raises InputError for whatever cannot be used.
    """
    notes = describe_unsupported(request.images)
    with scratch_folder() as folder:
        given = None if request.cameras == ESTIMATE else Path(request.cameras)
        photographs = images = find_input_images(request.images, given, request.camera_format, folder)
        decoded: dict[Path, np.ndarray] = {}
        if given is None:
            from ..sfm.estimate import estimate_cameras

            images = pick_frames(images, request.frames)
            wanted = _wanted(request, model, images)
            skipped: list[str] = []
            cameras = estimate_cameras(images, request.focal, None if request.frames else skipped, decoded)
            notes += skipped
            notes.append(_estimated(len(images) - len(skipped), cameras))
            images = [Path(camera.name) for camera in cameras]
        else:
            with working("reading cameras"):
                cameras = read_cameras(given, images, request.camera_format)
            images = pick_frames(images, request.frames)
            wanted = _wanted(request, model, images)
        pairs = match_images_to_cameras(images, cameras)
        if request.frames is None and len(cameras) > len(pairs):
            notes.append(f"{len(cameras) - len(pairs)} of {len(cameras)} cameras have no photograph among those given")
        own = [camera if path.parent != folder else replace(camera, name=path.name) for path, camera in pairs]
        height, width = parse_size(request.size) if request.size else model.size_for(own)
        count = min(wanted or len(pairs), len(pairs))
        model.check_size(max(count, MIN_VIEWS), height, width)
        with working("choosing and reading photographs"):
            read: list[ImageCameraPair] = [(decoded.get(path, path), camera) for path, camera in pairs]
            views = build_view_batch(read, count, height, width, skip_damaged=request.frames is None)
    notes += [f"{line}; left out" for line in views.skipped]
    if request.views and request.views > len(pairs):
        notes.append(f"--views {request.views}: all {len(pairs)} photographs used; there are no more with a camera")
    notes += _cut(views.cameras[0], height, width, model)
    if views.selection_reason:
        notes.append(
            f"{count} of {len(pairs)} photographs used: {', '.join(views.names)}; {views.selection_reason} "
            "(--views for more, --frames to choose)"
        )
    return Inputs(views, photographs, own, notes)


def pick_frames(images: Sequence[Path], frames: str | None) -> list[Path]:
    """The images that --frames names, in its order: names with or without suffix, or numbers counted from 0.

    Ranges of numbers are first-last, and start:stop:step without the stop. What is the name of an image is that image.
    Raises InputError for what is none of the images.
    """
    if frames is None:
        return list(images)
    picked = []
    for word in (word.strip() for word in frames.split(",")):
        named = [image for image in images if word in (image.name, image_stem(image))]
        chosen = named or [images[number] for number in _numbers(word, len(images))]
        if len(named) > 1 or not chosen:
            problem = f"{len(named)} of the {len(images)} images are called so" if named else "no image is called so"
            raise InputError(
                f"--frames {word}: {problem}; expected names such as {images[0].name}, or numbers from 0 to "
                f"{len(images) - 1}, also as 0-3 or 0:8:2, with commas between"
            )
        picked += chosen
    if len(set(picked)) < len(picked):
        raise InputError(f"--frames {frames}: names an image twice, expected each once")
    return picked


def _numbers(word: str, count: int) -> Sequence[int]:
    """The numbers below `count` that a number, a range or a slice stands for; none where one of them is not."""
    if found := RANGE.fullmatch(word):
        first = int(found[1])
        numbers = range(first, int(found[2] or first) + 1)
    elif found := SLICE.fullmatch(word):
        start, stop, step = (int(part) if part else None for part in found.groups())
        numbers = range(start or 0, count if stop is None else stop, step or 1) if step != 0 else range(0)
    else:
        return []
    return numbers if numbers and numbers[-1] < count else []


def _wanted(request: Request, model: ModelFiles, picked: Sequence[Path]) -> int | None:
    """How many views to use of the images that --frames names; None for all."""
    return model.view_count(request.views, len(picked) if request.frames else None, DEFAULT_VIEWS)


def _cut(camera: Camera, height: int, width: int, model: ModelFiles) -> list[str]:
    """A line that tells of the part of the photographs that is cut off, where that is much, and of a size without."""
    crop = cover_crop(camera.width, camera.height, width, height)
    share = width * height / (crop.width * crop.height)
    if share >= MUCH:
        return []
    own = model.metadata
    whole = nearest_size(camera.height / camera.width, own.height * own.width, own.size_multiple)
    remedy = "" if own.fixed_size else f"; --size {whole[0]}x{whole[1]} takes in nearly all"
    return [f"the middle {height}x{width} of each photograph is used, {100 * share:.0f} % of it{remedy}"]


def _estimated(photographs: int, cameras: Sequence[Camera]) -> str:
    by = "OpenCV" if photographs == MIN_VIEWS else "COLMAP's mapper"
    left = f", {photographs - len(cameras)} could not be placed" if len(cameras) < photographs else ""
    return (
        f"cameras of {len(cameras)} photographs estimated by {by}{left}; the first is the world's origin, and the unit "
        f"is the median depth of what they see, since photographs do not know their scale; {_focal_lengths(cameras)}"
    )


def _focal_lengths(cameras: Sequence[Camera]) -> str:
    focals = sorted(float(camera.K[0, 0]) for camera in cameras)
    span = dict.fromkeys(f"{focal:.0f}" for focal in (focals[0], focals[-1]))
    first = cameras[0]
    return f"focal length {' to '.join(span)} pixels, of photographs {first.width} wide and {first.height} high"
