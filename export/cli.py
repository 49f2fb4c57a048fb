"""The command idesplat-export: a checkpoint to ONNX, verified."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..runtime.cli.outputs import Overwrite, guards_outputs, outputs
from ..runtime.cli.terminal import run, say, warn
from ..runtime.errors import InputError, exit_on_input_error
from ..runtime.images.sizes import describe_size_rule, is_valid_size, parse_size
from ..runtime.inference.metadata import ModelMetadata, StageFile, write_manifest
from ..runtime.system.files import check_writable, make_folder

if TYPE_CHECKING:
    from ..model.common.network import Network
    from .stages import Stage
    from .tracing import Graphs, StaticShape

MISMATCH = 1
# More views, or pixels in all of them, are not baked in: tracing runs the network in PyTorch once, and IDESplat takes
# some 6 kB a pixel for it.
MOST_VIEWS = 64
MOST_PIXELS = 1 << 24


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
    views: Annotated[int | None, typer.Option(help="Bake in the number of views.", min=2, max=MOST_VIEWS)] = None,
    size: Annotated[str | None, typer.Option(help="Bake in the image size, such as 256x256.")] = None,
    precision: Annotated[
        str, typer.Option(help="float32, int8 (for processors) or fp16 (for graphics cards).")
    ] = "float32",
    overwrite: Overwrite = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print the error of every tensor in every case.")] = False,
) -> None:
    """Write a checkpoint as a standard ONNX graph (opset 20), and prove that it computes the same.

    Views, height and width stay dynamic unless fixed by --views and --size.
    """
    with _naming_what_fails("choose another name"):
        staged = staged.resolve() if staged is not None and staged.is_symlink() else staged
        outputs().reads("the checkpoint", [checkpoint])
        _check_targets(out, staged)
    if find_spec("torch") is None or find_spec("onnx") is None:
        raise InputError("exporting needs PyTorch and onnx, which are not installed; pip install 'idesplat[export]'")
    from ..model.checkpoint import CheckpointError
    from .precision.convert import PRECISIONS
    from .tracing import StaticShape

    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision}: unknown; choose one of {', '.join(PRECISIONS)}")
    with _naming_what_fails("choose another name"):
        _check_existing(out, staged)
    try:
        model, name, digest = _load(checkpoint, preset)
    except CheckpointError as error:
        raise InputError(str(error)) from None
    static = StaticShape(views, _fitting_size(size, views, model.config.size_multiple) if size else None)
    description = describe(model, name, checkpoint.name, digest, static, precision)
    with _naming_what_fails("choose a folder on a disk with room for it"):
        passed = _export(model, description, static, out, staged, verbose)
    if not passed:
        warn("error: the graph departs from the network (see the table); nothing was written")
        raise SystemExit(MISMATCH)


def main() -> None:
    """Entry point of idesplat-export."""
    run(export)


@contextmanager
def _naming_what_fails(remedy: str) -> Iterator[None]:
    """Raise InputError for what the system says of a path: a name that is too long, links in a circle, a full disk."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "Symlink loop" not in str(error):
            raise
        raise InputError(f"cannot write the result ({error}); {remedy}") from None


def _check_targets(out: Path | None, staged: Path | None) -> None:
    """Find out before minutes of work whether the results can be written."""
    if out is None and staged is None:
        raise InputError("nothing to write: give OUT.onnx, or --staged DIR, or both")
    if out is not None:
        if out.suffix != ".onnx":
            raise InputError(f"{out}: the output must end in .onnx")
        outputs().make_folder(out.parent)
        check_writable(out.parent)
    if staged is not None:
        if staged.exists() and not staged.is_dir():
            raise InputError(f"--staged {staged}: is a file, expected a folder")
        if out is not None and staged.resolve() in (out.resolve(), *out.resolve().parents):
            raise InputError(f"--staged {staged}: is replaced as a whole; choose a place outside it for {out}")
        outputs().writes_into("--staged", staged)
        outputs().make_folder(staged.parent)
        check_writable(staged.parent)


def _check_existing(out: Path | None, staged: Path | None) -> None:
    """Raise InputError if the results would replace anything that idesplat-export did not write."""
    from .existing_exports import check_replaceable, is_our_graph

    if out is not None:
        outputs().writes("", [out], known=is_our_graph(out))
    if staged is not None and staged.is_dir():
        check_replaceable(staged)


def _fitting_size(text: str, views: int | None, multiple: int) -> tuple[int, int]:
    """`HEIGHTxWIDTH`, multiples of what the network needs."""
    height, width = parse_size(text)
    if not is_valid_size(height, width, multiple):
        raise InputError(f"--size {text}: {describe_size_rule(multiple)}")
    from .validation.cases import MOST_VIEWS_OF_A_CASE

    count = views or MOST_VIEWS_OF_A_CASE
    if count * height * width > MOST_PIXELS:
        raise InputError(
            f"--size {text}: {count} views of it have more than {MOST_PIXELS:,} pixels; choose a smaller one"
        )
    return height, width


def _load(checkpoint: Path, preset: str | None) -> "tuple[Network, str, str]":
    """The network with the file's weights, the preset's name, and the file's SHA-256."""
    from ..model.checkpoint import file_sha256, fill, infer_preset, name_hash_warning, read_state_dict
    from ..model.registry import PRESETS, build

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
    model: "Network", preset: str, checkpoint: str, digest: str, static: "StaticShape", precision: str = "float32"
) -> ModelMetadata:
    """What an exported network says of itself."""
    config = model.config
    height, width = static.size or (config.height, config.width)
    return ModelMetadata(
        preset=preset,
        height=height,
        width=width,
        size_multiple=config.size_multiple,
        fixed_size=static.size is not None,
        fixed_views=static.views or 0,
        near=config.near,
        far=config.far,
        trained_views=list(config.trained_views),
        trained_sides=list(config.trained_sides),
        sh_degree=config.sh_degree,
        checkpoint=checkpoint,
        checkpoint_sha256=digest,
        version=version("idesplat"),
        gaussians=model.has_gaussians,
        precision=precision,
    )


def _export(
    model: "Network",
    description: ModelMetadata,
    static: "StaticShape",
    out: Path | None,
    staged: Path | None,
    verbose: bool,
) -> bool:
    """Trace, verify and write; False and nothing written if the graph departs from the network.

    The work is done in folders beside the results, from where these are only moved: a system's own folder for
    temporary files may lie in memory.
    """
    from rich.console import Console

    from .existing_exports import replace_folder, working_folder
    from .graph.external_data import check_weights, publish, save_model
    from .stages import NamedTensors
    from .tracing import OPSET, export_graphs
    from .validation.compare import Exported, verify
    from .validation.report import print_details, print_summary

    console = Console(stderr=True)
    network = NamedTensors(model)
    with ExitStack() as stack:
        parents = dict.fromkeys(path.parent for path in (out, staged) if path is not None)
        folders = {parent: stack.enter_context(working_folder(parent)) for parent in parents}
        working = next(iter(folders.values()))
        with console.status("tracing the network (a minute or so)"):
            graphs = export_graphs(network, description, static, make_folder(working / "graphs"))
        say(f"traced: {graphs.nodes} nodes, opset {OPSET}, {graphs.bytes / 1e6:.0f} MB")
        fused = save_model(graphs.whole, make_folder(folders[out.parent] / "fused") / out.name) if out else []
        new = make_folder(folders[staged.parent] / "staged") if staged else None
        stages = _write_stages(graphs, new) if new else [(stage, graphs.of_stage(stage)) for stage in graphs.stages]
        errors = []
        with console.status("verifying against PyTorch") as status:
            exported = Exported(stages, staged is not None, fused[0] if fused else None)
            for error in verify(network, exported, description, static):
                errors.append(error)
                status.update(f"verifying against PyTorch: {error.stage}, {error.case}")
        (print_details if verbose else print_summary)(errors)
        if not all(error.passed for error in errors):
            return False
        if fused:
            check_weights(graphs.whole, fused[0])
        for stage, path in stages if staged else []:
            check_weights(graphs.of_stage(stage), path)
        if out is not None:
            _say_written(publish(fused, out.parent), out, description)
        if staged is not None and new is not None:
            replace_folder(new, staged)
            _say_written([staged], staged, description)
    return True


def _write_stages(graphs: "Graphs", folder: Path) -> "list[tuple[Stage, Path]]":
    """Write one graph a stage and the manifest into an empty folder; the stages, each with its graph."""
    from .graph.external_data import save_model

    files = [
        StageFile(stage.name, f"{stage.name}.onnx", list(stage.inputs), list(stage.outputs)) for stage in graphs.stages
    ]
    for stage, file in zip(graphs.stages, files, strict=True):
        save_model(graphs.of_stage(stage), folder / file.file)
    write_manifest(folder, files)
    return [(stage, folder / file.file) for stage, file in zip(graphs.stages, files, strict=True)]


def _say_written(paths: list[Path], model: Path, description: ModelMetadata) -> None:
    """What was written and how to use it."""
    say(*(f"wrote {path}" for path in paths))
    if len(paths) > 1:
        say(f"{paths[1].name} holds the weights: move it along with {model.name}")
    makes = "a splat" if description.gaussians else "depth and a point cloud"
    say(f"make {makes} with: idesplat-infer --model {model} --images ... --cameras ... --out scene.ply")
