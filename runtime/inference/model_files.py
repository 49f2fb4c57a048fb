"""The files of an exported model, with metadata that is read before a graph is loaded."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path

from ..cameras.camera import Camera
from ..errors import InputError
from ..images.sizes import describe_size_rule, is_valid_size
from ..system.files import open_regular
from .metadata import INPUTS, ModelMetadata, StageFile, expected_outputs, read_manifest, read_metadata
from .metadata_fields import shown
from .named_models import find_model
from .onnx_metadata import read_properties

FUSED = "model"  # the name of the one stage of a model in one file
# A TensorProto whose values lie in another file names it by the entry "location" of external_data.
LOCATION = re.compile(rb"\n\x08location\x12([\x01-\x7f])", re.DOTALL)
# The same with a name of 128 bytes and more, whose length takes two bytes.
LONG_LOCATION = re.compile(rb"\n\x08location\x12[\x80-\xff][\x01-\x7f]", re.DOTALL)
MAX_FILE_BYTES = (1 << 31) - 1  # protobuf reads no message of 2 GiB or more


@dataclass(frozen=True)
class ModelFiles:
    """A `.onnx` file of this project, or a folder of staged graphs, with its metadata.

    path: the file or folder. stages: its graphs in the order in which they run; a single file is the stage "model".
    """

    path: Path
    metadata: ModelMetadata
    stages: list[StageFile]

    def file_of(self, stage: StageFile) -> Path:
        """The graph of one stage."""
        return (self.path if self.path.is_dir() else self.path.parent) / stage.file

    def size_for(self, cameras: Sequence[Camera]) -> tuple[int, int]:
        """The trained height and width, in portrait format where most images are and the model leaves the choice."""
        own = self.metadata
        upright = sum(camera.height > camera.width for camera in cameras) * 2 > len(cameras)
        turn = upright and own.width > own.height and not own.fixed_size
        return (own.width, own.height) if turn else (own.height, own.width)

    def view_count(
        self, asked: int | None, named: int | None, default: int | None, naming: str = "--select"
    ) -> int | None:
        """How many views to use; None for all.

        asked: by --views. named: how many images the option `naming` names. default: where neither is given, and the
        model takes any number.
        Raises InputError where the model was exported for a number of views, and another is asked for.
        """
        fixed = self.metadata.fixed_views
        if not fixed:
            return asked or (None if named else default)
        if asked is not None and asked != fixed:
            raise InputError(f"--views {asked}: {self._fixed()}; use --views {fixed}, or export without --views")
        if named is not None and (named < fixed or (named > fixed and asked is None)):
            more = "" if named < fixed else f", or add --views {fixed} to have the best of them chosen"
            raise InputError(f"{naming} names {named} images: {self._fixed()}; name {fixed}{more}")
        return fixed

    def check_size(self, views: int, height: int, width: int) -> None:
        """Raise InputError unless the model takes this many views of this size."""
        own = self.metadata
        if own.fixed_views and views != own.fixed_views:
            raise InputError(f"{self._fixed()} and got {views}; give {own.fixed_views}, or export without --views")
        if own.fixed_size and (height, width) != (own.height, own.width):
            raise InputError(
                f"{self.path}: was exported for {own.height}x{own.width} and got {height}x{width}; "
                f"use --size {own.height}x{own.width}, or export without --size"
            )
        if not is_valid_size(height, width, own.size_multiple):
            rule = describe_size_rule(own.size_multiple)
            raise InputError(f"{self.path}: cannot take images of {height}x{width}; {rule}")

    def _fixed(self) -> str:
        return f"{self.path} was exported for {self.metadata.fixed_views} views"


def read_model(path: Path | str) -> ModelFiles:
    """The files and metadata of an exported model; no graph is loaded.

    path: a `.onnx` of this project, a folder that `idesplat-export --staged` wrote, or a name (`find_model`).
    Raises InputError if there is no such model, a file is not one of ours or damaged, or refers to weights outside its
    folder.
    """
    path = find_model(path)
    if not path.exists():
        raise InputError(f"{path}: no such model; give a .onnx file or staged folder made by idesplat-export")
    if path.is_dir():
        stages = read_manifest(path)
        files = [path / stage.file for stage in stages]
    else:
        stages, files = [], [path]
    for file in files:
        _check_file(file)
    metadata = read_metadata(read_properties(files[0]), path)
    return ModelFiles(
        path, metadata, stages or [StageFile(FUSED, path.name, list(INPUTS), list(expected_outputs(metadata)))]
    )


def _check_file(path: Path) -> None:
    """Raise InputError for a graph that no ONNX file can be, or whose weights lie outside its folder or are missing.

    ONNX Runtime refuses most of this, too, but not in every version, and waits for ever for a named pipe.
    """
    if not path.is_file():
        raise InputError(f"{path}: is no regular file, expected a .onnx file made by idesplat-export")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(f"{path}: has {size >> 30} GiB, expected a graph of less than 2 GiB; is it an .onnx file?")
    if size:
        for location in _external_names(path):
            _check_location(path, location)


def external_files(path: Path) -> list[Path]:
    """The files beside a graph that hold some of its weights; raises InputError if their names are not readable."""
    return [path.parent / name for name in sorted(_external_names(path))] if path.stat().st_size else []


def _external_names(path: Path) -> Iterator[str]:
    """The names of the files that hold some of a graph's weights."""
    with open_regular(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        if LONG_LOCATION.search(content):
            raise InputError(f"{path}: keeps weights in a file whose name has more than 127 bytes; export it again")
        for found in {content[at.end() : at.end() + at.group(1)[0]] for at in LOCATION.finditer(content)}:
            yield found.decode(errors="replace")


def _check_location(path: Path, location: str) -> None:
    folder = path.parent.resolve()
    try:
        beside = (folder / location).resolve()
        inside = not Path(location).is_absolute() and beside.is_relative_to(folder)
        there = beside.is_file()
    except ValueError:  # a name that no file can have
        inside = there = False
    if not inside:
        raise InputError(f"{path}: keeps weights in {shown(location)}, outside its folder; expected a file beside it")
    if not there:
        raise InputError(f"{path}: keeps weights in {shown(location)}, which is no file; move it along with the graph")
