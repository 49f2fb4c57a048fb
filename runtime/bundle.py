"""What an exported model says of itself: metadata inside every `.onnx`, and the manifest of a staged folder."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from .errors import InputError

# The metadata property that holds the description as JSON, and the only version of its layout so far.
METADATA_KEY = "idesplat"
LAYOUT = 1
MANIFEST_NAME = "manifest.json"
INPUTS = ("images", "extrinsics", "intrinsics", "near", "far")
OUTPUTS = ("depth", "means", "scales", "quats", "opacities", "sh")
CONVENTIONS = (
    "images RGB in [0, 1]; extrinsics camera-to-world with OpenCV axes; intrinsics divided by width and height; "
    "near, far and depth in scene units along z; quats wxyz; sh in the 3DGS basis, world frame"
)


@dataclass(frozen=True)
class Description:
    """How a model is to be fed and what it yields."""

    preset: str
    # Trained image size; other sizes must be multiples of `size_multiple`, unless `fixed_size` is true.
    height: int
    width: int
    size_multiple: int
    fixed_size: bool
    # Zero means any number from two.
    fixed_views: int
    # The range of depth it was trained with, in scene units.
    near: float
    far: float
    # The fewest and the most views it was trained with, and the shortest and longest side of its images.
    trained_views: list[int]
    trained_sides: list[int]
    sh_degree: int
    checkpoint: str
    checkpoint_sha256: str
    # Version of idesplat that exported it.
    version: str
    # Whether it yields Gaussians, as all models before this field did, or depth alone.
    gaussians: bool = True
    # What the parts that bear it compute in: float32, int8 or fp16. Inputs, outputs and geometry are always in float32.
    precision: str = "float32"
    conventions: str = CONVENTIONS
    layout: int = LAYOUT

    def to_json(self) -> str:
        """The metadata property."""
        return json.dumps(asdict(self))


@dataclass(frozen=True)
class StageFile:
    """One graph of a staged folder."""

    name: str
    file: str
    inputs: list[str]
    outputs: list[str]


def read_description(properties: dict[str, str], path: Path) -> Description:
    """The description in a model's metadata properties; raises InputError if the model is not ours."""
    if METADATA_KEY not in properties:
        lack = f"not a model of this project (no '{METADATA_KEY}' metadata)"
        raise InputError(f"{path}: {lack}; make one with idesplat-export")
    try:
        content = json.loads(properties[METADATA_KEY])
        if content.get("layout") != LAYOUT:
            found = f"metadata layout {content.get('layout')!r}, expected {LAYOUT}"
            raise InputError(f"{path}: {found}; export it again with this version")
        return _from_dict(Description, content)
    except (ValueError, TypeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: damaged metadata ({error}); export it again") from None


def write_manifest(folder: Path, stages: list[StageFile]) -> None:
    """Write the list of a staged folder's graphs, in the order in which they run."""
    content = {"format": "idesplat-staged", "layout": LAYOUT, "stages": [asdict(stage) for stage in stages]}
    (folder / MANIFEST_NAME).write_text(json.dumps(content, indent=2) + "\n")


def read_manifest(folder: Path) -> list[StageFile]:
    """The graphs of a staged folder; raises InputError if it has no valid manifest or misses a file."""
    path = folder / MANIFEST_NAME
    try:
        content = json.loads(path.read_text())
        stages = [_from_dict(StageFile, entry) for entry in content["stages"]]
    except FileNotFoundError:
        raise InputError(f"{folder}: no {MANIFEST_NAME}, expected a folder made by idesplat-export --staged") from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: damaged manifest ({error}); export it again") from None
    for stage in stages:
        if Path(stage.file).name != stage.file or not (folder / stage.file).is_file():
            raise InputError(f"{path}: names {stage.file}, which is not in the folder; export it again")
    return stages


def _from_dict(kind: type, content: dict[str, Any]) -> Any:
    names = {field.name for field in fields(kind)}
    return kind(**{key: value for key, value in content.items() if key in names})
