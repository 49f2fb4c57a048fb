"""The model that is carried along, so that photographs become splats with nothing downloaded (see MODEL_CARD.md)."""

import hashlib
from pathlib import Path

from ..errors import InputError

NAME = "idesplat-tiny.onnx"
FOLDER = Path(__file__).with_name("bundled")
# Beside the model, as `sha256sum` writes it and `sha256sum --check` reads it.
CHECKSUM_SUFFIX = ".sha256"


def bundled_model() -> Path:
    """The carried model's path; raises InputError if the file is not the one that was carried."""
    path = FOLDER / NAME
    remedy = "install idesplat again, or give --model"
    try:
        expected = path.with_name(NAME + CHECKSUM_SUFFIX).read_text().split()[0]
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, IndexError) as error:
        raise InputError(f"{path}: the carried model cannot be read ({error}); {remedy}") from None
    if found != expected:
        raise InputError(f"{path}: the carried model is damaged (SHA-256 {found[:8]}, not {expected[:8]}); {remedy}")
    return path
