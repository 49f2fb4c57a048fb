"""A camera file or folder whose format is not known yet."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..system.files import open_regular
from .parsing import read_json

START_LENGTH = 4096  # bytes
BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class CameraSource:
    """What the formats' `detect` functions look at; each part is read when first needed, and once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def is_folder(self) -> bool:
        """Whether the path is a folder."""
        return self.path.is_dir()

    @cached_property
    def start(self) -> bytes:
        """The first bytes of a file, without leading white space; empty for a folder. Raises InputError."""
        if self.is_folder:
            return b""
        try:
            with open_regular(self.path) as file:
                return file.read(START_LENGTH).removeprefix(BYTE_ORDER_MARK).lstrip()
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror}); expected a file of cameras") from None

    @cached_property
    def document(self) -> Mapping[str, Any]:
        """The object in a JSON file; empty for other files and folders. Raises InputError for invalid JSON."""
        is_json = self.path.suffix.lower() == ".json" or self.start.startswith((b"{", b"["))
        return read_json(self.path) if is_json and not self.is_folder else {}
