"""The command idesplat-export: a checkpoint to ONNX, verified."""

import shutil
import sys
import tempfile
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..runtime.bundle import MANIFEST_NAME, Description, StageFile, write_manifest
from ..runtime.errors import InputError, exit_on_input_error
from ..runtime.outputs import Overwrite, guards_outputs, outputs
from ..runtime.sizes import parse_size, size_fits, size_rule
from ..runtime.terminal import run, say, warn

if TYPE_CHECKING:
    from ..model.networks import Network
    from .exporter import Fixed, Graphs
    from .verify import Parity

PARITY_BREACH = 1


@exit_on_input_error
@guards_outputs("idesplat-export")
def export(
    checkpoint: Annotated[
        Path, typer.Argument(help="Released checkpoint: .ckpt, .pth or .safetensors.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Argument(help="The .onnx to write.", show_default=False)] = None,
    preset: Annotated[
        str | None, typer.Option(help="What the file was trained as, where its name does not say.")
    ] = None,
    staged: Annotated[Path | None, typer.Option(help="Folder for one graph a stage, with a manifest.")] = None,
    views: Annotated[int | None, typer.Option(help="Bake in the number of views.", min=2)] = None,
    size: Annotated[str | None, typer.Option(help="Bake in the image size, such as 256x256.")] = None,
    precision: Annotated[
        str, typer.Option(help="float32, int8 (for processors) or fp16 (for graphics cards).")
    ] = "float32",
    overwrite: Overwrite = False,
) -> None:
    """Write a checkpoint as a standard ONNX graph (opset 20), and prove that it computes the same.

    Views, height and width stay dynamic unless fixed by --views and --size.
    """
    outputs().reads("the checkpoint", [checkpoint])
    folder = _check_targets(out, staged)
    if find_spec("torch") is None or find_spec("onnx") is None:
        raise InputError("exporting needs PyTorch and onnx, which are not installed; pip install 'idesplat[export]'")
    from ..model.checkpoint import CheckpointError
    from .exporter import Fixed
    from .precision import PRECISIONS

    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision}: unknown; choose one of {', '.join(PRECISIONS)}")
    try:
        model, name, digest = _load(checkpoint, preset)
    except CheckpointError as error:
        raise InputError(str(error)) from None
    fixed = Fixed(views, _fitting_size(size, model.config.size_multiple) if size else None)
    description = describe(model, name, checkpoint.name, digest, fixed, precision)
    if not _export(model, description, fixed, folder, out, staged):
        warn("error: the graph departs from the network (see the table); nothing was written")
        raise SystemExit(PARITY_BREACH)


def main() -> None:
    """Entry point of idesplat-export."""
    run(export)


def _check_targets(out: Path | None, staged: Path | None) -> Path:
    """Find out before minutes of work whether the results can be written; the folder of the first of them."""
    folders = [path.parent for path in (out, staged) if path is not None]
    if not folders:
        raise InputError("nothing to write: give OUT.onnx, or --staged DIR, or both")
    if out is not None:
        if out.suffix != ".onnx":
            raise InputError(f"{out}: the output must end in .onnx")
        outputs().writes("", [out])
        outputs().make_folder(out.parent)
    if staged is not None:
        if staged.exists() and not staged.is_dir():
            raise InputError(f"--staged {staged}: is a file, expected a folder")
        if staged.is_dir() and any(staged.iterdir()) and not (staged / MANIFEST_NAME).is_file():
            raise InputError(f"--staged {staged}: holds other files; choose an empty or new folder")
        outputs().writes_into("--staged", staged)
        outputs().make_folder(staged.parent)
    return folders[0]


def _fitting_size(text: str, multiple: int) -> tuple[int, int]:
    """`HEIGHTxWIDTH`, multiples of what the network needs."""
    height, width = parse_size(text)
    if not size_fits(height, width, multiple):
        raise InputError(f"--size {text}: {size_rule(multiple)}")
    return height, width


def _load(checkpoint: Path, preset: str | None) -> "tuple[Network, str, str]":
    """The network with the file's weights, the preset's name, and the file's SHA-256."""
    from ..model.checkpoint import file_sha256, fill, infer_preset, name_hash_warning, read_state_dict
    from ..model.config import PRESETS
    from ..model.networks import build

    if preset is not None and preset not in PRESETS:
        raise InputError(f"--preset {preset}: unknown; choose one of {', '.join(PRESETS)}")
    say(f"reading {checkpoint}")
    digest = file_sha256(checkpoint)
    warning = name_hash_warning(checkpoint, digest)
    if warning:
        warn(f"warning: {warning}")
    tensors = read_state_dict(checkpoint)
    name = preset or infer_preset(checkpoint, tensors)
    model = build(name)
    fill(model, tensors, checkpoint)
    count = sum(parameter.numel() for parameter in model.parameters())
    say(f"preset {name}, {count:,} parameters")
    return model.eval(), name, digest


def describe(
    model: "Network", preset: str, checkpoint: str, digest: str, fixed: "Fixed", precision: str = "float32"
) -> Description:
    """What an exported network says of itself."""
    from ..model.depthsplat import DepthSplatDepth

    config = model.config
    height, width = fixed.size or (config.height, config.width)
    return Description(
        preset=preset,
        height=height,
        width=width,
        size_multiple=config.size_multiple,
        fixed_size=fixed.size is not None,
        fixed_views=fixed.views or 0,
        near=config.near,
        far=config.far,
        trained_views=list(config.trained_views),
        trained_sides=list(config.trained_sides),
        sh_degree=config.sh_degree,
        checkpoint=checkpoint,
        checkpoint_sha256=digest,
        version=version("idesplat"),
        gaussians=not isinstance(model, DepthSplatDepth),
        precision=precision,
    )


def _export(
    model: "Network", description: Description, fixed: "Fixed", folder: Path, out: Path | None, staged: Path | None
) -> bool:
    """Trace, verify and write; False and nothing written if the graph departs from the network.

    The work is done in a folder beside the results: a system's own for temporary files may lie in memory.
    """
    from rich.console import Console

    from .exporter import OPSET, freeze
    from .stages import NamedTensors
    from .verify import verify
    from .weights import hand_out

    console = Console(stderr=True)
    network = NamedTensors(model)
    with tempfile.TemporaryDirectory(prefix=".idesplat-export.", dir=folder) as working:
        with console.status("tracing the network (a minute or so)"):
            graphs = freeze(network, description, fixed, Path(working))
        say(f"traced: {graphs.nodes} nodes, opset {OPSET}, {graphs.bytes / 1e6:.0f} MB")
        rows = []
        with console.status("verifying against PyTorch") as status:
            for row in verify(network, graphs, description, fixed):
                rows.append(row)
                status.update(f"verifying against PyTorch: {row.stage}, {row.case}")
        _print_table(rows)
        if not all(row.passed for row in rows):
            return False
        if out is not None:
            _say_written(hand_out(graphs.whole, out), out, description)
        if staged is not None:
            _write_stages(graphs, staged)
            _say_written([staged], staged, description)
    return True


def _write_stages(graphs: "Graphs", staged: Path) -> None:
    """One graph a stage and the manifest, in a folder that appears whole."""
    from .weights import hand_out

    temporary = Path(tempfile.mkdtemp(prefix=f".{staged.name}.", dir=staged.parent))
    try:
        files = []
        for stage in graphs.stages:
            files.append(StageFile(stage.name, f"{stage.name}.onnx", list(stage.inputs), list(stage.outputs)))
            hand_out(graphs.of_stage(stage), temporary / files[-1].file)
        write_manifest(temporary, files)
        temporary.chmod(0o755)
        if staged.exists():
            shutil.rmtree(staged)
        temporary.rename(staged)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _say_written(paths: list[Path], model: Path, description: Description) -> None:
    """What was written and how to use it."""
    say(*(f"wrote {path}" for path in paths))
    if len(paths) > 1:
        say(f"{paths[1].name} holds the weights: move it along with {model.name}")
    makes = "a splat" if description.gaussians else "depth and a point cloud"
    say(f"make {makes} with: idesplat-infer --model {model} --images ... --cameras ... --out scene.ply")


def _print_table(rows: "list[Parity]") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="ONNX Runtime against PyTorch, in standard deviations of each tensor")
    for column in ("case", "stage", "tensor"):
        table.add_column(column)
    for column in ("largest", "median", "tolerance"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for row in rows:
        numbers = (f"{value:.1e}" for value in (row.largest, row.median, row.tolerance))
        table.add_row(row.case, row.stage, row.tensor, *numbers, "ok" if row.passed else "DEPARTS")
    Console(width=None if sys.stdout.isatty() else 120).print(table)
