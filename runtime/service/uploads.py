"""Receiving a scene: the parts of a multipart request as files in a job's folder, each checked before it is queued."""

import asyncio
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from starlette.datastructures import FormData, UploadFile
from starlette.requests import Request
from starlette.types import Message, Receive

from ..cameras.formats import CAMERA_SUFFIXES, ESTIMATE
from ..errors import InputError
from ..images.finding import SUFFIXES, find_images
from ..images.header import DamagedImage, image_size
from .archives import is_zip, safe_name, unpack
from .limits import MIB, Limits, Refused

IMAGES, CAMERAS = "images", "cameras"
MAX_CAMERA_FILES = 400  # DTU and OpenCV have one a view
MAX_FIELDS = 64
MAX_FIELD_BYTES = 4096
IDLE_S = 10.0  # without a byte of a request's body
MIN_IMAGES = 2
# AVIF, HEIC and WebP are parsed by native libraries: their headers are read in the worker process.
HEADER = 12
NATIVE = {(4, 8): b"ftyp", (8, 12): b"WEBP"}


@dataclass(frozen=True)
class Upload:
    """What a client has sent, as files. folder: of the images. cameras: a file or folder, "estimate", or None to look
    beside the images. images: in natural order. texts: the other form fields.
    """

    folder: Path
    cameras: Path | str | None
    images: Sequence[Path]
    texts: Mapping[str, str]


@dataclass
class _LimitedReceive:
    """The `receive` of a request with limits on its time and size."""

    receive: Receive
    limits: Limits
    size: int = 0
    started: float = field(default_factory=time.monotonic)

    async def __call__(self) -> Message:
        left = self.started + self.limits.upload_seconds - time.monotonic()
        try:
            async with asyncio.timeout(min(IDLE_S, max(left, 0))):
                message = await self.receive()
        except TimeoutError:
            raise Refused(408, "the upload comes too slowly; send fewer or smaller images") from None
        self.add(len(message.get("body", b"")))
        return message

    def add(self, size: int) -> None:
        """Count bytes."""
        self.size += size
        if self.size > self.limits.upload_bytes:
            most = self.limits.upload_bytes / MIB
            raise Refused(413, f"the upload is larger than {most:g} MiB; send fewer or smaller images")


async def receive_scene(request: Request, folder: Path, limits: Limits) -> Upload:
    """Store the images and cameras of a multipart request in a new folder.

    Raises Refused and InputError for what is not taken; HTTPException for a body that is too large or malformed.
    """
    kind = request.headers.get("content-type", "")
    if not kind.lower().startswith("multipart/form-data"):
        raise Refused(415, "expected multipart/form-data with the files `images`, and `cameras` if there are any")
    declared = request.headers.get("content-length", "")
    if declared.isdecimal():
        _LimitedReceive(request.receive, limits).add(int(declared))
    guarded = Request(request.scope, _LimitedReceive(request.receive, limits))
    async with guarded.form(
        max_files=limits.images + MAX_CAMERA_FILES, max_fields=MAX_FIELDS, max_part_size=MAX_FIELD_BYTES
    ) as form:
        return await asyncio.to_thread(_store, form, folder, limits)


def _store(form: FormData, folder: Path, limits: Limits) -> Upload:
    images, cameras, texts = _sorted(form)
    given: Path | str | None = None
    if len(images) == 1 and is_zip(images[0].file):
        place = folder / "scene"
        unpack(images[0].file, place, limits)
        place = _without_wrapper(place)
    else:
        if len(images) > limits.images:
            raise Refused(413, f"{len(images)} images, expected {limits.images} at most")
        place, given = folder / IMAGES, ESTIMATE
        _save(images, place, SUFFIXES, "images")
    found = _check_images(place, limits)
    if cameras:
        _save(cameras, folder / CAMERAS, CAMERA_SUFFIXES, "cameras")
        given = folder / CAMERAS if len(cameras) > 1 else next((folder / CAMERAS).iterdir())
    elif texts.get(CAMERAS):
        if texts[CAMERAS] != ESTIMATE:
            raise InputError(f"cameras: expected files, or the word {ESTIMATE}")
        given = ESTIMATE
    return Upload(place, given, found, {name: text for name, text in texts.items() if name != CAMERAS})


def _sorted(form: FormData) -> tuple[list[UploadFile], list[UploadFile], dict[str, str]]:
    """The files `images`, the files `cameras`, and the texts by their names."""
    files: dict[str, list[UploadFile]] = {IMAGES: [], CAMERAS: []}
    texts: dict[str, str] = {}
    for name, value in form.multi_items():
        if isinstance(value, UploadFile):
            if name not in files:
                raise InputError(f"file {name[:40]!r}: expected the files {IMAGES} and {CAMERAS}")
            if value.filename:  # a form sends an empty part for a field without files
                files[name].append(value)
        elif name in texts:
            raise InputError(f"field {name[:40]!r}: given twice")
        else:
            texts[name] = value
    if not files[IMAGES]:
        raise InputError(f"no images; expected files called {IMAGES}: two or more images, or one zip of them")
    if len(files[CAMERAS]) > MAX_CAMERA_FILES:
        raise Refused(413, f"{len(files[CAMERAS])} camera files, expected {MAX_CAMERA_FILES} at most")
    return files[IMAGES], files[CAMERAS], texts


def _save(files: list[UploadFile], folder: Path, suffixes: tuple[str, ...], what: str) -> None:
    """Write uploaded files under their own names, which must be different and of the right kind."""
    folder.mkdir()
    taken: set[str] = set()
    for file in files:
        name = safe_name(file.filename or "")
        if Path(name).suffix.lower() not in suffixes or name.startswith("."):
            raise Refused(415, f"{name}: not one of the {what} by its suffix; expected {', '.join(suffixes)}")
        if name.casefold() in taken:
            raise InputError(f"{name}: two {what} have this name; rename one")
        taken.add(name.casefold())
        with (folder / name).open("xb") as target:
            shutil.copyfileobj(file.file, target, MIB)


def _without_wrapper(folder: Path) -> Path:
    """The one folder that a zip consists of, where there is nothing beside it."""
    inside = list(folder.iterdir()) if folder.is_dir() else []
    if len(inside) == 1 and inside[0].is_dir() and inside[0].name != IMAGES:
        return inside[0]
    return folder


def _check_images(folder: Path, limits: Limits) -> list[Path]:
    """Read every image's header; the images. Raises InputError and Refused."""
    found = [path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES]
    if len(found) < MIN_IMAGES:
        raise InputError(f"{len(found)} images, expected {MIN_IMAGES} or more, or one zip of them")
    images = find_images(found)
    for path in images:
        with path.open("rb") as file:
            start = file.read(HEADER)
        if any(start[slice(*place)] == mark for place, mark in NATIVE.items()):
            continue
        too_large = Refused(413, f"{path.name}: too many pixels, expected {limits.megapixels} megapixels at most")
        try:
            width, height = image_size(path)
        except DamagedImage as error:
            raise InputError(str(error).replace(str(path), path.name)) from None
        except InputError:  # above the limit of `image_size` itself
            raise too_large from None
        if width * height > limits.megapixels * 10**6:
            raise too_large
    return images
