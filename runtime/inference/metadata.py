"""Metadata of exported models: a property in every `.onnx`, and the manifest of a staged folder."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ..errors import InputError
from ..system.files import read_bytes
from .metadata_fields import Check, checked_fields, distance, flag, names, pair, parse_object, shown, string, whole

# The metadata property that holds `ModelMetadata` as JSON, and the only version of its layout so far.
METADATA_KEY = "idesplat"
LAYOUT = 1
MANIFEST_NAME = "manifest.json"
MANIFEST_FORMAT = "idesplat-staged"
# Limits far beyond every existing network.
MAX_STAGES = 32
MAX_BYTES = 1 << 20  # of metadata and manifests
MAX_SIDE = 1 << 16  # pixels
MAX_VIEWS = 1 << 12
MAX_SH_DEGREE = 3
INPUTS = ("images", "extrinsics", "intrinsics", "near", "far")
OUTPUTS = ("depth", "means", "scales", "quats", "opacities", "sh")
CONVENTIONS = (
    "images RGB in [0, 1]; extrinsics camera-to-world with OpenCV axes; intrinsics divided by width and height; "
    "near, far and depth in scene units along z; quats wxyz; sh in the 3DGS basis, world frame"
)


@dataclass(frozen=True)
class ModelMetadata:
    """The inputs that a model expects, what it was trained on, and what it predicts."""

    preset: str
    # Trained image size; other sizes must be multiples of `size_multiple`, unless `fixed_size` is true.
    height: int
    width: int
    size_multiple: int
    fixed_size: bool
    # 0 for any number of views from two.
    fixed_views: int
    # The range of depth it was trained with, in scene units.
    near: float
    far: float
    # The least and the greatest number of views in training, and the shortest and longest side of its images.
    trained_views: list[int]
    trained_sides: list[int]
    sh_degree: int
    checkpoint: str
    checkpoint_sha256: str
    # Version of idesplat that exported it.
    version: str
    # Whether it predicts Gaussians, as all models did before this field, or depth only.
    gaussians: bool = True
    # float32, int8 or fp16, for the layers that tolerate it. Inputs, outputs and geometry are always float32.
    precision: str = "float32"
    # cpu, gpu or web: what the graph's operators were chosen for. Every graph runs everywhere.
    target: str = "cpu"
    conventions: str = CONVENTIONS
    layout: int = LAYOUT

    def to_json(self) -> str:
        """The value of the metadata property."""
        return json.dumps(asdict(self))


@dataclass(frozen=True)
class StageFile:
    """One graph of a staged folder."""

    name: str
    file: str
    inputs: list[str]
    outputs: list[str]


_SIDE, _VIEWS = whole(1, MAX_SIDE), whole(1, MAX_VIEWS)
_METADATA_CHECKS: dict[str, Check] = {
    "preset": string,
    "height": _SIDE,
    "width": _SIDE,
    "size_multiple": _SIDE,
    "fixed_size": flag,
    "fixed_views": whole(0, MAX_VIEWS),
    "near": distance,
    "far": distance,
    "trained_views": pair(_VIEWS),
    "trained_sides": pair(_SIDE),
    "sh_degree": whole(0, MAX_SH_DEGREE),
    "checkpoint": string,
    "checkpoint_sha256": string,
    "version": string,
    "gaussians": flag,
    "precision": string,
    "target": string,
    "conventions": string,
}
_ADDED_LATER = frozenset({"gaussians", "precision", "target", "conventions"})
_STAGE: dict[str, Check] = {"name": string, "file": string, "inputs": names, "outputs": names}


def expected_outputs(metadata: ModelMetadata) -> Sequence[str]:
    """The outputs of a model."""
    return OUTPUTS if metadata.gaussians else OUTPUTS[:1]


def read_metadata(properties: dict[str, str], path: Path) -> ModelMetadata:
    """The metadata in a model's properties; raises InputError if the model is not of this project, or damaged."""
    if METADATA_KEY not in properties:
        lack = f"not a model of this project (no '{METADATA_KEY}' metadata)"
        raise InputError(f"{path}: {lack}; make one with idesplat-export")
    text = properties[METADATA_KEY]
    try:
        if len(text) > MAX_BYTES:
            raise InputError(f"{len(text)} characters, expected {MAX_BYTES} at most")
        content = parse_object(text)
        layout = content.get("layout")
        if isinstance(layout, bool) or layout != LAYOUT:
            found = f"metadata layout {shown(layout)}, expected {LAYOUT}"
            raise InputError(f"{found}; export it again with this version")
        metadata = ModelMetadata(**checked_fields(content, _METADATA_CHECKS, _ADDED_LATER))
        _check_metadata(metadata)
    except InputError as error:
        raise InputError(f"{path}: damaged metadata: {error}; export it again") from None
    return metadata


def _check_metadata(own: ModelMetadata) -> None:
    """Raise InputError where fields contradict each other."""
    if not own.near < own.far:
        raise InputError(f"near {own.near:g} and far {own.far:g}, expected near < far")
    if own.fixed_views == 1:
        raise InputError("fixed_views is 1, expected 0 for any number, or two or more")
    if own.height % own.size_multiple or own.width % own.size_multiple:
        raise InputError(f"size {own.height}x{own.width}, expected multiples of {own.size_multiple}")


def write_manifest(folder: Path, stages: list[StageFile]) -> None:
    """Write the manifest of a staged folder: its graphs in the order in which they run."""
    content = {"format": MANIFEST_FORMAT, "layout": LAYOUT, "stages": [asdict(stage) for stage in stages]}
    (folder / MANIFEST_NAME).write_text(json.dumps(content, indent=2) + "\n")


def read_manifest(folder: Path) -> list[StageFile]:
    """The graphs of a staged folder; raises InputError if its manifest is not valid, or a file missing."""
    path = folder / MANIFEST_NAME
    if not path.exists():
        raise InputError(f"{folder}: no {MANIFEST_NAME}, expected a folder made by idesplat-export --staged")
    content = read_bytes(path, "the manifest of a staged folder", MAX_BYTES)
    try:
        stages = _stages(parse_object(content))
        for stage in stages:
            if Path(stage.file).name != stage.file or not (folder / stage.file).is_file():
                raise InputError(f"names {shown(stage.file)}, which is not in the folder")
        _check_order(stages)
    except (InputError, ValueError, OSError) as error:  # the last two from names that no file can have
        raise InputError(f"{path}: damaged manifest: {error}; export it again") from None
    return stages


def _stages(content: dict[str, object]) -> list[StageFile]:
    """The entries of a manifest, each checked by itself."""
    if content.get("format") != MANIFEST_FORMAT:
        raise InputError(f'format is {shown(content.get("format"))}, expected "{MANIFEST_FORMAT}"')
    layout = content.get("layout")
    if isinstance(layout, bool) or layout != LAYOUT:
        raise InputError(f"layout is {shown(layout)}, expected {LAYOUT}")
    entries = content.get("stages")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_STAGES:
        raise InputError(f"stages is {shown(entries)}, expected a list of 1 to {MAX_STAGES}")
    stages = []
    for index, entry in enumerate(entries):
        try:
            stages.append(StageFile(**checked_fields(entry, _STAGE)))
        except InputError as error:
            raise InputError(f"stages[{index}]: {error}") from None
    return stages


def _check_order(stages: Sequence[StageFile]) -> None:
    """Check that names and files are unique, inputs are available by then, and outputs are new."""
    for values, what in (([stage.name for stage in stages], "name"), ([stage.file for stage in stages], "file")):
        if len(set(values)) < len(values):
            raise InputError(f"two stages have the same {what}")
    known = set(INPUTS)
    for stage in stages:
        unknown = [name for name in stage.inputs if name not in known]
        if unknown:
            raise InputError(f"stage {shown(stage.name)} reads {shown(unknown[0])}, which no stage before it yields")
        twice = [name for name in stage.outputs if name in known]
        if twice:
            raise InputError(f"stage {shown(stage.name)} yields {shown(twice[0])}, which is there already")
        known |= set(stage.outputs)
