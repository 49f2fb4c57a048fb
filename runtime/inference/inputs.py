"""Inputs of a reconstruction: images or a video, given or estimated cameras, and the selection of views."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..cameras.discovery import find_cameras
from ..cameras.formats import ESTIMATE, CameraFormat
from ..cameras.io import read_cameras
from ..errors import InputError
from ..images.arrays import as_uint8_image
from ..images.finding import describe_unsupported, image_stem
from ..images.resizing import frame_crop
from ..images.sizes import whole_frame_size
from ..sfm.estimate import describe_estimate, estimate_cameras
from ..system.files import scratch_folder
from ..system.limits import parse_whole_number
from ..system.progress import working
from ..views.batch import ViewBatch, build_view_batch, images_with_cameras, match_images_to_cameras
from ..views.loader import ImageCameraPair
from ..views.selection import MIN_VIEWS
from ..views.sources import find_input_images
from .model_files import ModelFiles

DEFAULT_VIEWS = 2
ALL = "all"
# What --select takes beside names and numbers: 0-3 is 0, 1, 2, 3; 0:8:2 is 0, 2, 4, 6, as Python has it.
RANGE = re.compile(r"([0-9]{1,9})(?:-([0-9]{1,9}))?")
SLICE = re.compile(r"([0-9]{0,9}):([0-9]{0,9})(?::([0-9]{0,9}))?")
MIN_SHOWN_AREA = 0.7  # share of an image below which a note says that the rest is cropped


@dataclass(frozen=True)
class Request:
    """The arguments of a reconstruction, most of which `reconstruct` documents.

    pixels: least area of the images that the network gets; that of its training if larger. default_views: how many to
    use where neither `views` nor `select` says it; None for all. copy_side: of `ViewBatch.copies`.
    """

    images: Sequence[Path | str | np.ndarray]
    cameras: Path | str | Sequence[Camera] | None = None
    camera_format: CameraFormat | None = None
    focal: str | None = None
    select: str | None = None
    views: int | str | None = None  # "all" for all
    size: tuple[int, int] | None = None  # height, width
    crop: bool = False
    pixels: int = 0
    default_views: int | None = DEFAULT_VIEWS
    copy_side: int = 0


@dataclass(frozen=True, eq=False)
class Inputs:
    """The chosen views, and the images and cameras that they come from.

    views: the chosen images with their cameras. images: the files of all, chosen or not. cameras: those of all images.
    source: where the cameras come from, a path, "estimate" or "given". notes: lines for the user.
    """

    views: ViewBatch
    images: list[Path]
    cameras: list[Camera]
    source: str
    notes: list[str]

    @property
    def estimated(self) -> bool:
        """Whether the cameras were estimated."""
        return self.source == ESTIMATE


@dataclass
class _PosedImages:
    """Images with their cameras, before the selection of views.

    wanted: how many views are to be used; None for all. files: of all images that were given.
    """

    pairs: Sequence[ImageCameraPair]
    wanted: int | None
    files: list[Path] = field(default_factory=list)
    source: str = "given"
    notes: list[str] = field(default_factory=list)


def read_inputs(request: Request, model: ModelFiles) -> Inputs:
    """Read images and cameras, or estimate these, choose the views and bring them to the model's size.

    Raises InputError for whatever cannot be used.
    """
    with scratch_folder() as folder:
        posed = _posed_images(request, model, folder)
        pairs, notes = posed.pairs, posed.notes
        cameras = [_named_without(folder, image, camera) for image, camera in pairs]
        height, width = request.size or _network_size(request, model, cameras)
        count = min(posed.wanted or len(pairs), len(pairs))
        model.check_size(max(count, MIN_VIEWS), height, width)
        with working("choosing and reading images"):
            # Estimated cameras have been checked against the same matches.
            views = build_view_batch(
                pairs,
                count,
                height,
                width,
                skip_damaged=request.select is None,
                check_images=True,
                check_cameras=posed.source != ESTIMATE,
                copy_side=request.copy_side,
            )
    notes += [f"{line}; left out" for line in views.skipped] + [f"warning: {line}" for line in views.warnings]
    if isinstance(request.views, int) and request.views > len(pairs):
        notes.append(f"--views {request.views}: all {len(pairs)} images used; there are no more with a camera")
    notes += _describe_crops(views, height, width, request.crop or request.size is not None)
    if views.selection_reason:
        notes.append(
            f"{count} of {len(pairs)} images used: {', '.join(views.names)}; {views.selection_reason} "
            "(--views for more, --select to choose)"
        )
    return Inputs(views, posed.files, cameras, posed.source, notes)


def _posed_images(request: Request, model: ModelFiles, folder: Path) -> _PosedImages:
    """The images with their cameras, from any source. folder: for the frames of a video."""
    arrays = [image for image in request.images if isinstance(image, np.ndarray)]
    given: Path | str | Sequence[Camera] | None = request.cameras
    if arrays:
        return _PosedImages(_posed_arrays(request, arrays), _view_count(request, model, len(arrays)))
    items, notes = [Path(image) for image in request.images if not isinstance(image, np.ndarray)], []
    found = None
    if given is None:
        found = find_cameras(items)
        items, given = found.images, found.cameras or ESTIMATE
        notes.append(found.note)
    path = None if given == ESTIMATE or not isinstance(given, (str, Path)) else Path(given)
    notes += describe_unsupported(items)
    images = files = find_input_images(items, path, request.camera_format, folder)
    if given == ESTIMATE:
        posed = _with_estimated_cameras(request, model, files)
        posed.notes[:0] = notes
        return posed
    if not isinstance(given, (str, Path)):
        cameras = list(given)
    else:
        with working("reading cameras"):
            cameras = read_cameras(Path(given), images, request.camera_format)
    if found is not None and request.select is None:
        images = images_with_cameras(images, cameras)
        if len(images) < len(files):
            notes.append(f"{len(files) - len(images)} of {len(files)} images have no camera in {path}; left out")
    images = select_images(images, request.select)
    wanted = _view_count(request, model, len(images))
    pairs = match_images_to_cameras(images, cameras)
    if request.select is None and len(cameras) > len(pairs):
        notes.append(f"{len(cameras) - len(pairs)} of {len(cameras)} cameras have no image among those given")
    return _PosedImages(pairs, wanted, files, "given" if path is None else str(given), notes)


def _posed_arrays(request: Request, images: Sequence[np.ndarray]) -> Sequence[ImageCameraPair]:
    """Arrays with the cameras that are given for them, one for each."""
    cameras = request.cameras
    if len(images) < len(request.images) or cameras is None or isinstance(cameras, (str, Path)):
        raise InputError("images as arrays: expected all of them to be arrays, and a Camera for each")
    if request.select is not None:
        raise InputError(f"select {request.select}: images given as arrays have no names; give those that are wanted")
    if len(images) != len(cameras):
        raise InputError(f"{len(images)} images and {len(cameras)} cameras, expected one camera for each image")
    return [(as_uint8_image(image, camera.name), camera) for image, camera in zip(images, cameras, strict=True)]


def _with_estimated_cameras(request: Request, model: ModelFiles, files: list[Path]) -> _PosedImages:
    """The images whose cameras could be estimated."""
    images = select_images(files, request.select)
    wanted = _view_count(request, model, len(images))
    decoded: dict[Path, np.ndarray] = {}
    skipped: list[str] = []
    cameras = estimate_cameras(images, request.focal, None if request.select else skipped, decoded)
    notes = [*skipped, describe_estimate(len(images) - len(skipped), cameras)]
    pairs = match_images_to_cameras([Path(camera.name) for camera in cameras], cameras)
    return _PosedImages([(decoded.get(path, path), camera) for path, camera in pairs], wanted, files, ESTIMATE, notes)


def _named_without(folder: Path, image: Path | np.ndarray, camera: Camera) -> Camera:
    """The camera; of a video's frame, which lies in `folder` for a while, named without that folder."""
    path = image if isinstance(image, Path) else Path(camera.name)
    return replace(camera, name=path.name) if path.parent == folder else camera


def select_images(images: Sequence[Path], select: str | None) -> list[Path]:
    """The images that --select names, in its order: names with or without suffix, or numbers counted from 0.

    Ranges of numbers are first-last, and start:stop:step without the stop. What is the name of an image is that image.
    Raises InputError for what is none of the images.
    """
    if select is None:
        return list(images)
    selected = []
    for word in (word.strip() for word in select.split(",")):
        named = [image for image in images if word in (image.name, image_stem(image))]
        chosen = named or [images[number] for number in _numbers(word, len(images))]
        if len(named) > 1 or not chosen:
            problem = f"{len(named)} of the {len(images)} images are called so" if named else "no image is called so"
            raise InputError(
                f"--select {word}: {problem}; expected names such as {images[0].name}, or numbers from 0 to "
                f"{len(images) - 1}, also as 0-3 or 0:8:2, with commas between"
            )
        selected += chosen
    if len(set(selected)) < len(selected):
        raise InputError(f"--select {select}: names an image twice, expected each once")
    return selected


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


def _view_count(request: Request, model: ModelFiles, images: int) -> int | None:
    """How many views to use; None for all. Raises InputError where the model does not take as many."""
    asked = parse_views(request.views) if isinstance(request.views, str) else request.views
    if asked == ALL:
        return model.view_count(None, images, None, f"--views {ALL}")
    return model.view_count(int(asked) if asked else None, images if request.select else None, request.default_views)


def parse_views(text: str) -> int | str:
    """The option --views: a number, or `all`; raises InputError."""
    count = parse_whole_number(text)
    if text != ALL and (count is None or count < MIN_VIEWS):
        raise InputError(f"--views {text[:40]}: expected a number from {MIN_VIEWS}, or {ALL}")
    return count or ALL


def _network_size(request: Request, model: ModelFiles, cameras: Sequence[Camera]) -> tuple[int, int]:
    """Height and width of the network's input: of the shape that most images have, unless they are to be cropped."""
    own = model.metadata
    if own.fixed_size or request.crop:
        return model.size_for(cameras)
    aspect = float(np.median([camera.height / camera.width for camera in cameras]))
    return whole_frame_size(aspect, max(own.height * own.width, request.pixels), own.size_multiple)


def _describe_crops(views: ViewBatch, height: int, width: int, asked: bool) -> list[str]:
    """A note on images of which only the middle is used; asked: whether the user gave the size or asked for a crop."""
    shares = []
    for camera in views.cameras:
        crop = frame_crop(camera.width, camera.height, width, height)
        shares.append(width * height / (crop.width * crop.height))
    if min(shares) >= (MIN_SHOWN_AREA if asked else 1):
        return []
    cropped = [name for name, share in zip(views.names, shares, strict=True) if share < 1]
    which = "each image" if len(cropped) == len(shares) else ", ".join(cropped)
    remedy = "leave out --size and --crop for the whole" if asked else "its shape is not that of the others"
    return [f"of {which} the middle {height}x{width} is used, {100 * min(shares):.0f} % of it; {remedy}"]
