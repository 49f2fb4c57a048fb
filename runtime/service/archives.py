"""Unpacking an uploaded zip: within limits, and never outside of the folder that it is unpacked to."""

import errno
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from ..cameras.formats import CAMERA_SUFFIXES
from ..errors import InputError, printable
from ..images.finding import SUFFIXES
from .limits import MIB, Limits, Refused

MAX_ENTRIES_BEYOND_IMAGES = 1000
MAX_DIRECTORY = 4 * MIB  # bytes of the list of entries, which zipfile reads whole
MAX_DEPTH = 8  # folders within each other
MAX_NAME = 200  # bytes of one part of a path
CHUNK = 1 << 20
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# What zipfile raises for damaged files.
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError)
ENCRYPTED = 1  # flag of an entry
END, END_SIZE = b"PK\x05\x06", 22  # the record at a zip's end, and its size without the comment
ZIP64_LOCATOR, ZIP64_LOCATOR_SIZE = b"PK\x06\x07", 20
MAX_COMMENT = 1 << 16
RESERVED = '<>:"\\|?*'


def is_zip(file: BinaryIO) -> bool:
    """Whether a file begins as a zip does."""
    start = file.read(4)
    file.seek(0)
    return start in (b"PK\x03\x04", END)


def unpack(file: BinaryIO, folder: Path, limits: Limits) -> None:
    """Unpack the images and camera files of a zip into a new folder; other files and hidden ones are left out.

    Raises InputError for a damaged zip, or names that lead out of the folder; Refused for one beyond the limits.
    """
    _check_directory(file)
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            if len(entries) > limits.images + MAX_ENTRIES_BEYOND_IMAGES:
                raise Refused(413, f"the zip has {len(entries)} entries, expected {limits.images} images at most")
            wanted = [(entry, path) for entry in entries if (path := _place(entry)) is not None]
            _check_images([path for _, path in wanted], limits)
            left = limits.upload_bytes
            for entry, path in wanted:
                left -= _extract(archive, entry, folder / path, left)
    except DAMAGED as error:
        if isinstance(error, InputError) or getattr(error, "errno", None) == errno.ENOSPC:
            raise
        raise InputError(f"the zip cannot be unpacked ({printable(str(error))[:200]}); pack it again") from None


def safe_name(name: str) -> str:
    """A file's name that was uploaded, without folders. Raises InputError unless every system can store it."""
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    if not _is_safe(last):
        raise InputError(f"{printable(name)[:80]!r}: not a usable file name; expected one such as image-1.jpg")
    return last


def _check_directory(file: BinaryIO) -> None:
    """Check the size of the list of entries, of which zipfile makes objects before anything can be counted."""
    file.seek(0, 2)
    size = file.tell()
    file.seek(max(0, size - END_SIZE - MAX_COMMENT - ZIP64_LOCATOR_SIZE))
    tail = file.read()
    at = tail.rfind(END)
    if at < 0 or len(tail) - at < END_SIZE:
        raise InputError("the zip is damaged: it has no end; upload it again")
    if tail[max(0, at - ZIP64_LOCATOR_SIZE) : at].startswith(ZIP64_LOCATOR):
        raise InputError("the zip is in the zip64 format for files of 4 GiB and more; pack it without")
    (directory,) = struct.unpack_from("<L", tail, at + 12)
    if directory > MAX_DIRECTORY:
        raise Refused(413, f"the zip lists {directory >> 20} MiB of entries, expected {MAX_DIRECTORY >> 20} at most")
    file.seek(0)


def _place(entry: zipfile.ZipInfo) -> Path | None:
    """Where to unpack an entry, relative; None for a folder, a hidden file, and what is no image or camera file."""
    name = entry.filename
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if name.startswith(("/", "\\")) or ".." in parts or (len(name) > 1 and name[1] == ":"):
        raise InputError(f"the zip holds {printable(name)[:80]!r}, which leads out of it; pack it again")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise InputError(f"the zip holds {printable(name)[:80]!r}, which is a link; pack the file itself")
    if name.endswith("/") or any(part.startswith((".", "__MACOSX")) for part in parts):
        return None
    if PurePosixPath(name).suffix.lower() not in (*SUFFIXES, *CAMERA_SUFFIXES):
        return None
    if entry.flag_bits & ENCRYPTED:
        raise InputError("the zip is encrypted; pack it without a password")
    if entry.compress_type not in COMPRESSIONS:
        raise InputError("the zip is compressed in an unusual way; pack it with deflate")
    if len(parts) > MAX_DEPTH or not all(map(_is_safe, parts)):
        raise InputError(f"the zip holds {printable(name)[:80]!r}; expected plain names, {MAX_DEPTH} folders at most")
    return Path(*parts)


def _is_safe(part: str) -> bool:
    plain = part == printable(part) and not any(character in RESERVED for character in part)
    fits = 0 < len(part.encode("utf-8", "surrogatepass")) <= MAX_NAME
    return plain and fits and part not in (".", "..") and not part.endswith((" ", "."))


def _check_images(paths: list[Path], limits: Limits) -> None:
    images = sum(path.suffix.lower() in SUFFIXES for path in paths)
    if images > limits.images:
        raise Refused(413, f"{images} images, expected {limits.images} at most")
    if len({str(path).casefold() for path in paths}) < len(paths):
        raise InputError("the zip holds two files of one name; pack it again")


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, most: int) -> int:
    """Unpack one file; its size. The sizes that a zip declares may be wrong, so what comes out is counted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with archive.open(entry) as source, path.open("xb") as target:
        while chunk := source.read(CHUNK):
            size += len(chunk)
            if size > most:
                raise Refused(413, "the zip unpacks to more than an upload may have; send fewer or smaller images")
            target.write(chunk)
    return size
