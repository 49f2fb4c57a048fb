"""The log of a training run: one JSON object a line."""

import json
import math
from pathlib import Path
from typing import Any

from ...runtime.errors import raise_input_error
from ...runtime.system.files import atomic_write, read_bytes


class TrainingLog:
    """One entry a step; when a run is resumed, entries after its checkpoint are dropped."""

    def __init__(self, path: Path, step: int) -> None:
        """path: the file. step: the number of steps done, beyond which entries are dropped."""
        self.path = path
        self.entries = [entry for entry in _read(path) if entry["step"] <= step]
        with atomic_write(path) as temporary:
            temporary.write_text("".join(json.dumps(entry) + "\n" for entry in self.entries))

    def add(self, entry: dict[str, Any]) -> None:
        """Append an entry, which has a `step`."""
        self.entries.append(entry)
        with self.path.open("a") as file:
            file.write(json.dumps(entry) + "\n")


def finite(value: float) -> float | None:
    """The value rounded to six decimals; None if JSON cannot represent it."""
    return round(value, 6) if math.isfinite(value) else None


def _read(path: Path) -> list[dict[str, Any]]:
    """The entries of a log. The last line may be incomplete, if the run was killed, and is then left out.

    Raises InputError for any other line that is no entry, since rewriting the log would lose it.
    """
    if not path.exists() or (path.is_file() and not path.stat().st_size):
        return []
    lines = read_bytes(path, "the log of a training run").decode(errors="replace").split("\n")
    entries = []
    for number, line in enumerate(lines, start=1):
        entry = _parse(line)
        if entry is not None:
            entries.append(entry)
        elif number < len(lines):  # complete lines end with a newline, so they are not the last part
            raise_input_error(
                path, f"line {number} is none of a training log", "move the file away, or choose another --out"
            )
    return entries


def _parse(line: str) -> dict[str, Any] | None:
    """The entry of a line; None if it is none."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(entry, dict) or type(entry.get("step")) is not int:
        return None
    numbers = (value for value in entry.values() if value is not None)
    return entry if all(type(value) is int or isinstance(value, float) for value in numbers) else None
