"""Places of scenes and results: local paths, and URLs of object stores, which fsspec opens."""

import os
import posixpath
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from ..errors import InputError, one_line

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

INSTALL = "pip install 'idesplat[remote]'"
STORES = ("s3", "gs", "gcs", "az", "abfs", "memory")
LOCAL = "file"
URL = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]+)(?:::|:/)")
EXPECTED = f"expected a local path, or a URL that begins with {', '.join(f'{name}://' for name in STORES)}"

Place = Path | str  # a local path, or the URL of a store


def parse_place(text: Path | str) -> Place:
    """A local path, also of a URL with file://, or the URL of a store; raises InputError for anything else."""
    text = str(text)
    url = URL.match(text)
    if url is None:
        return _local(text)
    protocol = url[1].lower()
    if protocol == LOCAL:
        return _local(unquote(urlsplit(text).path))
    if protocol not in STORES or not text[len(protocol) :].startswith("://"):
        raise InputError(f"{text}: {EXPECTED}")
    return text.rstrip("/")


def _local(text: str) -> Path:
    try:
        invalid = b"\0" in os.fsencode(text)
    except ValueError:
        invalid = True
    if invalid:
        raise InputError(f"{text!a}: no file can have this name; give a local path")
    return Path(text)


def join(place: Place, name: str) -> Place:
    """The place of this name in a folder."""
    return place / name if isinstance(place, Path) else f"{place}/{name}"


def beside(place: Place, name: str) -> Place:
    """What a table at `place` calls `name`: a place of its own, or relative to the table's folder."""
    given = parse_place(name)
    if isinstance(place, Path):
        return place.parent / given if isinstance(given, Path) else given
    if not isinstance(given, Path) or given.is_absolute():
        return given
    protocol, _, path = place.partition("://")
    return f"{protocol}://{posixpath.normpath(posixpath.join(posixpath.dirname(path), name))}"


def open_store(url: str) -> tuple["AbstractFileSystem", str]:
    """The file system of a store, and the path there; raises InputError where a package for it is missing."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise InputError(f"{url}: needs fsspec; {INSTALL}") from None
    with store_errors(url):
        # Listings change while others write.
        found: tuple[Any, str] = url_to_fs(url, use_listings_cache=False)
    return found


@contextmanager
def store_errors(url: str) -> Iterator[None]:
    """Raise InputError for whatever a store's client raises: their errors have no class in common."""
    try:
        yield
    except InputError:
        raise
    except ImportError as error:
        raise InputError(f"{url}: {error}; {INSTALL}, or the package of this store") from error
    except FileNotFoundError as error:
        raise InputError(f"{url}: no such file or folder") from error
    except Exception as error:
        raise InputError(f"{url}: the store answers: {one_line(error)}; check its name and credentials") from error
