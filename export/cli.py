"""The command `idesplat export`: a checkpoint to ONNX, verified against PyTorch."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.cli.options import Config, Overwrite, Quiet
from ..runtime.cli.outputs import command
from ..runtime.cli.reporting import mark_printed, note
from ..runtime.cli.terminal import run, say, warn
from ..runtime.images.sizes import parse_size
from .pipeline import MAX_VIEWS, MIN_VIEWS, ExportResult, MismatchError, export_checkpoint

MISMATCH = 1  # exit status


@command("idesplat export")
def export(
    checkpoint: Annotated[
        Path, typer.Argument(help="Released checkpoint: .ckpt, .pth or .safetensors.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Argument(help="The .onnx to write.", show_default=False)] = None,
    preset: Annotated[
        str | None, typer.Option(help="What the file was trained as, where its name does not say.")
    ] = None,
    staged: Annotated[Path | None, typer.Option(help="Folder for one graph a stage, with a manifest.")] = None,
    views: Annotated[
        int | None, typer.Option(help="Make the number of views static.", min=MIN_VIEWS, max=MAX_VIEWS)
    ] = None,
    size: Annotated[str | None, typer.Option(help="Make the image size static, such as 256x256.")] = None,
    precision: Annotated[
        str, typer.Option(help="float32, fp16 (for GPUs), int8 (for CPUs) or int8-qdq (for TensorRT and QNN).")
    ] = "float32",
    target: Annotated[
        str, typer.Option(help="cpu, gpu or web: gpu and web have no Loop; web runs wholly on WebGPU.")
    ] = "cpu",
    opset: Annotated[int, typer.Option(help="Version of ONNX's operators, 17 to 21.")] = 20,
    calibrate: Annotated[
        Path | None,
        typer.Option(help="Images on which the ranges of int8 are found, with --cameras.", show_default=False),
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option("--cameras", "-c", help="Cameras of the images of --calibrate.", show_default=False)
    ] = None,
    external_data: Annotated[
        bool, typer.Option("--external-data", help="Write the weights to a file of their own.")
    ] = False,
    hub: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a model hub: onnx/model*.onnx, config.json, model card, checksums.", show_default=False
        ),
    ] = None,
    triton: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a model repository of NVIDIA Triton: the fused graph, and an ensemble of the stages.",
            show_default=False,
        ),
    ] = None,
    no_verify: Annotated[
        bool, typer.Option("--no-verify", help="Do not compare the graphs with PyTorch, which takes a minute or so.")
    ] = False,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            help="Print the error of every tensor in every case, and log to stderr what is done; twice: in detail.",
            show_default=False,
        ),
    ] = 0,
    quiet: Quiet = False,
) -> None:
    """Write a checkpoint as a standard ONNX graph, and verify it against PyTorch.

    Views, height and width stay dynamic unless --views and --size make them static.
    """
    image_size = parse_size(size) if size else None
    with _logging_to_terminal():
        try:
            result = export_checkpoint(
                *(checkpoint, out, staged),
                preset=preset,
                views=views,
                size=image_size,
                precision=precision,
                target=target,
                opset=opset,
                verify=not no_verify,
                external_data=external_data,
                calibrate=calibrate,
                cameras=cameras,
                hub=hub,
                triton=triton,
                overwrite=overwrite,
            )
        except MismatchError as error:
            _print_errors(error, bool(verbose))
            warn(f"error: {error} (see the table)")
            raise SystemExit(MISMATCH) from None
    if no_verify:
        warn("warning: the graphs were not compared with PyTorch (--no-verify)")
    else:
        _print_errors(result, bool(verbose))
    _print_files(result, triton)


def main() -> None:
    """Entry point of idesplat-export."""
    run(export)


class _TerminalHandler(logging.Handler):
    """Prints what the export logs: information on stdout, warnings on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        if record.levelno >= logging.WARNING:
            warn(f"warning: {record.getMessage()}")
        else:
            note(record.getMessage())
        mark_printed(record)


@contextmanager
def _logging_to_terminal() -> Iterator[None]:
    logger, handler = logging.getLogger(__package__), _TerminalHandler()
    level = logger.level
    logger.addHandler(handler)
    handler.setLevel(logging.INFO)
    logger.setLevel(min(logging.INFO, logger.getEffectiveLevel()))  # lower with -vv, for the log
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def _print_errors(result: ExportResult | MismatchError, verbose: bool) -> None:
    from .validation.report import print_details, print_summary

    (print_details if verbose else print_summary)(result.errors)


def _print_files(result: ExportResult, triton: Path | None) -> None:
    """What was written, and how to use it."""
    say(*(f"wrote {path}" for path in result.files))
    if triton is not None:
        say(f"serve it with: tritonserver --model-repository {triton}")
        return
    graphs = [path for path in result.files if path.is_dir() or path.suffix == ".onnx"]
    for weights in (path for path in result.files if path.suffix == ".data"):
        say(f"{weights.name} holds the weights: move it along with {graphs[0].name}")
    makes = "Gaussians" if result.metadata.gaussians else "depth and a point cloud"
    for graph in graphs:
        say(f"make {makes} with: idesplat infer PHOTOS --model {graph}")
