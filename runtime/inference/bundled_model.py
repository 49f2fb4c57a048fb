"""The bundled model, with which images become splats without a download (see MODEL_CARD.md)."""

import hashlib
from pathlib import Path

from ..errors import InputError

NAME = "idesplat-lite.onnx"
FOLDER = Path(__file__).with_name("bundled")
# The file beside the model, in the format of `sha256sum`.
CHECKSUM_SUFFIX = ".sha256"


def bundled_model() -> Path:
    """Path of the bundled model; raises InputError if the file is missing or its SHA-256 is not the expected one."""
    path = FOLDER / NAME
    remedy = "install idesplat again, or give --model"
    try:
        expected = path.with_name(NAME + CHECKSUM_SUFFIX).read_text().split()[0]
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, IndexError) as error:
        raise InputError(f"{path}: the bundled model cannot be read ({error}); {remedy}") from None
    if found != expected:
        raise InputError(f"{path}: the bundled model is damaged (SHA-256 {found[:8]}, not {expected[:8]}); {remedy}")
    return path
