"""Export of a checkpoint to verified ONNX graphs, as a library function: the whole of `idesplat export`."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from ..runtime.errors import InputError
from ..runtime.images.sizes import describe_size_rule, is_valid_size
from ..runtime.inference.metadata import ModelMetadata
from ..runtime.system.files import check_writable
from ..runtime.system.outputs import Outputs
from ..runtime.system.progress import ProgressCallback, reporting_to
from .targets import GraphSettings, check_opset, parse_target

if TYPE_CHECKING:
    from ..model.common.network import Network
    from .tracing import StaticShape
    from .validation.compare import TensorError

COMMAND = "idesplat-export"  # in the record of what was written
# Limits of static shapes: tracing runs the network in PyTorch once, and IDESplat takes some 6 kB a pixel for it.
MIN_VIEWS, MAX_VIEWS = 2, 64
MAX_PIXELS = 1 << 24


@dataclass(frozen=True)
class ExportResult:
    """What an export wrote.

    files: the graph and, where these are not in it, its weights; the staged folder; the files of a hub folder.
    errors: of every tensor in every verification case against PyTorch, with their bounds; none without verification.
    """

    metadata: ModelMetadata
    files: list[Path]
    errors: "list[TensorError]"


class MismatchError(RuntimeError):
    """The graphs compute something else than the network in PyTorch, so nothing was written.

    errors: of every tensor in every verification case, with their bounds.
    """

    def __init__(self, errors: "list[TensorError]") -> None:
        super().__init__("the graph differs from the network by more than the tolerance; nothing was written")
        self.errors = errors


def export_checkpoint(
    checkpoint: Path | str,
    out: Path | str | None = None,
    staged: Path | str | None = None,
    *,
    preset: str | None = None,
    views: int | None = None,
    size: tuple[int, int] | None = None,
    precision: str = "float32",
    target: str = "cpu",
    opset: int = 20,
    verify: bool = True,
    external_data: bool = False,
    calibrate: Path | str | None = None,
    cameras: Path | str | None = None,
    hub: Path | str | None = None,
    triton: Path | str | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> ExportResult:
    """Write a checkpoint as a standard ONNX graph, verified against PyTorch in ONNX Runtime.

    checkpoint: `.ckpt`, `.pth` or `.safetensors`, a released file or one of idesplat-train.
    out: the `.onnx` file. hub: instead, a folder in the layout of model hubs, to which graphs of several exports can be
    added. staged: a folder for one graph a stage, with a manifest; it is replaced as a whole. triton: instead of these,
    a folder for a model repository of NVIDIA Triton, to which several exports can be added. One of the four is needed.
    preset: what the file was trained as, where its tensors and its name do not tell.
    views, size: make the number of views, or the image's height and width, static; else they stay dynamic.
    precision: "float32", "int8" (for CPUs), "int8-qdq" (for TensorRT and QNN) or "fp16" (for GPUs).
    target: "cpu", "gpu" or "web" (WebGPU); the last two have no Loop. opset: 17 to 21.
    verify: compare the graphs with PyTorch. external_data: write the weights to a file of their own.
    calibrate, cameras: images and their cameras, on which the ranges of int8 are found instead of noise and a synthetic
    room.
    overwrite: also replace a file at `out` that idesplat did not write.
    progress: called as the work advances; by default reports go where the caller's `reporting_to` sends them.
    Raises InputError if an argument or the file is unusable, or PyTorch is not installed; MismatchError if a tensor's
    error exceeds its bound.
    """
    checkpoint = Path(checkpoint)
    out, staged, hub, triton, calibrate, cameras = (
        Path(path) if path is not None else None for path in (out, staged, hub, triton, calibrate, cameras)
    )
    chosen, checked_opset = parse_target(target), check_opset(opset)
    if (calibrate is None) != (cameras is None):
        raise InputError("--calibrate and --cameras belong together: images, and the file of their cameras")
    with reporting_to(progress) if progress else nullcontext(), Outputs(COMMAND, overwrite) as outputs:
        require_pytorch()
        _check_precision(precision, calibrate is not None)
        if hub is not None:
            out = _hub_graph(outputs, hub, out, precision, target)
        if triton is not None:
            _check_triton(outputs, triton, out, staged)
        with _os_errors_as_input_errors("choose another name"):
            staged = staged.resolve() if staged is not None and staged.is_symlink() else staged
            outputs.reads("the checkpoint", [checkpoint])
            if triton is None:
                _check_targets(outputs, out, staged)
            _check_existing(outputs, out, staged)
        from . import conversion
        from .calibration_images import read_examples

        loaded = conversion.load(checkpoint, preset)
        static = _static_shape(views, size, loaded.model.config.size_multiple)
        metadata = conversion.build_metadata(
            loaded.model, loaded.preset, checkpoint.name, loaded.sha256, static, precision, target
        )
        examples = read_examples(calibrate, cameras, metadata) if calibrate and cameras else ()
        settings = GraphSettings(chosen, checked_opset, verify, external_data, examples)
        with _os_errors_as_input_errors("choose a folder on a disk with room for it"):
            if triton is not None:
                errors, files = _export_repository(outputs, loaded.model, metadata, static, triton, settings)
            else:
                errors, files = conversion.convert(loaded.model, metadata, static, out, staged, settings)
        if not files:
            raise MismatchError(errors)
        if hub is not None:
            from .hub import write_hub_files

            files += write_hub_files(hub, metadata, verify)
    return ExportResult(metadata, files, errors)


def _hub_graph(outputs: Outputs, hub: Path, out: Path | None, precision: str, target: str) -> Path:
    """Where the graph of a hub folder goes; raises InputError if the folder's other files must not be written."""
    from .hub import graph_path, hub_files

    if out is not None:
        raise InputError(f"{out}: with --hub the graph's name is given by its precision; leave it out")
    if hub.exists() and not hub.is_dir():
        raise InputError(f"--hub {hub}: is a file, expected a folder")
    outputs.writes("--hub", hub_files(hub))
    return graph_path(hub, precision, target)


def _check_triton(outputs: Outputs, triton: Path, out: Path | None, staged: Path | None) -> None:
    """Raise InputError if nothing can be written there, or other graphs are asked for, too."""
    if out is not None or staged is not None:
        raise InputError(f"--triton {triton}: holds the fused graph and the stages; leave out OUT, --staged and --hub")
    if triton.exists() and not triton.is_dir():
        raise InputError(f"--triton {triton}: is a file, expected a folder")
    outputs.make_folder(triton)
    check_writable(triton)


def _export_repository(
    outputs: Outputs,
    model: "Network",
    metadata: ModelMetadata,
    static: "StaticShape",
    triton: Path,
    settings: GraphSettings,
) -> "tuple[list[TensorError], list[Path]]":
    """Convert a network, and add its graphs to a repository: the errors, and the models' folders."""
    from . import conversion
    from .existing_exports import is_our_graph, working_folder
    from .triton import GRAPH, STAGED, repository_files, write_repository

    for file in repository_files(triton, metadata, model.stage_names):
        outputs.writes("--triton", [file], known=is_our_graph(file))
    with working_folder(triton) as working:
        errors, files = conversion.convert(model, metadata, static, working / GRAPH, working / STAGED, settings)
        return errors, write_repository(triton, working, metadata) if files else []


@contextmanager
def _os_errors_as_input_errors(remedy: str) -> Iterator[None]:
    """Raise InputError for a path's errors of the system: a name too long, links in a circle, a full disk."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "Symlink loop" not in str(error):
            raise
        raise InputError(f"cannot write the result ({error}); {remedy}") from None


def require_pytorch() -> None:
    """Raise InputError where PyTorch or onnx are not installed."""
    if find_spec("torch") is None or find_spec("onnx") is None:
        raise InputError("exporting needs PyTorch and onnx, which are not installed; pip install 'idesplat[export]'")


def _check_targets(outputs: Outputs, out: Path | None, staged: Path | None) -> None:
    """Check, before minutes of work, whether the results can be written."""
    if out is None and staged is None:
        raise InputError("nothing to write: give OUT.onnx, or --staged DIR, or both, or --hub DIR, or --triton DIR")
    if out is not None:
        if out.suffix != ".onnx":
            raise InputError(f"{out}: the output must end in .onnx")
        outputs.make_folder(out.parent)
        check_writable(out.parent)
    if staged is not None:
        if staged.exists() and not staged.is_dir():
            raise InputError(f"--staged {staged}: is a file, expected a folder")
        if out is not None and staged.resolve() in (out.resolve(), *out.resolve().parents):
            raise InputError(f"--staged {staged}: is replaced as a whole; choose a place outside it for {out}")
        outputs.writes_into("--staged", staged)
        outputs.make_folder(staged.parent)
        check_writable(staged.parent)


def _check_precision(precision: str, calibrated: bool) -> None:
    from .precision.convert import INT8, INT8_QDQ, PRECISIONS

    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision}: unknown; choose one of {', '.join(PRECISIONS)}")
    if calibrated and precision not in (INT8, INT8_QDQ):
        raise InputError(f"--calibrate: {precision} has no ranges to find; use it with --precision int8 or int8-qdq")


def _check_existing(outputs: Outputs, out: Path | None, staged: Path | None) -> None:
    """Raise InputError if the results would replace anything that idesplat-export did not write."""
    from .existing_exports import check_replaceable, is_our_graph

    if out is not None:
        outputs.writes("", [out], known=is_our_graph(out))
    if staged is not None and staged.is_dir():
        check_replaceable(staged)


def _static_shape(views: int | None, size: tuple[int, int] | None, multiple: int) -> "StaticShape":
    """The static views and size; raises InputError unless the network can be traced with them.

    multiple: of which height and width must be.
    """
    from .tracing import StaticShape
    from .validation.cases import MAX_CASE_VIEWS

    if views is not None and not MIN_VIEWS <= views <= MAX_VIEWS:
        raise InputError(f"--views {views}: expected {MIN_VIEWS} to {MAX_VIEWS}")
    if size is not None:
        height, width = size
        if not is_valid_size(height, width, multiple):
            raise InputError(f"--size {height}x{width}: {describe_size_rule(multiple)}")
        count = views or MAX_CASE_VIEWS
        if count * height * width > MAX_PIXELS:
            raise InputError(
                f"--size {height}x{width}: {count} views of it have more than {MAX_PIXELS:,} pixels; "
                "choose a smaller one"
            )
    return StaticShape(views, size)
