"""The command `idesplat batch`: many scenes to splat files."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ..views.exposure_mode import ExposureMode
from .options import (
    CamerasFormat,
    CloseHoles,
    Config,
    Crop,
    CropBorder,
    DepthJump,
    Device,
    Exposure,
    Far,
    Focal,
    MaxGaussians,
    MergeDuplicates,
    MinConsistency,
    MinOpacity,
    Model,
    Near,
    Offset,
    Overwrite,
    Provider,
    ProviderOption,
    QualityOption,
    Quiet,
    Refine,
    RemoveContradicted,
    Select,
    Size,
    Threads,
    Verbose,
    Views,
)
from .outputs import command
from .reporting import note
from .session_options import session_config
from .terminal import run, say, warn

SOME_FAILED = 3  # exit status
MAX_WORKERS = 1024


@command("idesplat batch")
def batch(
    *,
    scenes: Annotated[
        str,
        typer.Argument(
            help="Folder of scene folders; or .jsonl or .csv with the columns id, images, cameras, and options of "
            "this command by their names, which go before the command line. A path, or the URL of a store."
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out",
            "-o",
            help="Folder for <id>/scene.ply, <id>/record.json, summary.json and index.html. A path, or a URL such as "
            "s3://bucket/results.",
        ),
    ],
    model: Model = None,
    splat_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="Format of the splat files, by their suffix.",
            metavar="ply|compressed.ply|splat|spz|sog|glb",
        ),
    ] = "ply",
    engine: Annotated[
        str,
        typer.Option(help="local: processes on this machine. ray: actors of Ray.", metavar="local|ray"),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            help="With --engine ray: the cluster, or `auto` for the one of this machine; else Ray starts by itself.",
            metavar="auto|HOST:PORT",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(help="Processes, each with an opened model and its share of cores.", min=1, max=MAX_WORKERS),
    ] = 1,
    shard: Annotated[
        str | None,
        typer.Option(help="Do every N-th scene from the I-th on, I from 1: one job of an array.", metavar="I/N"),
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Try again what failed before.")] = False,
    max_failures: Annotated[
        int | None, typer.Option(help="Stop after so many failures.", min=1, show_default=False)
    ] = None,
    cache_size: Annotated[
        float,
        typer.Option(help="Of inputs from stores, keep at most so many gigabytes in the cache folder.", min=0),
    ] = 10.0,
    camera_format: CamerasFormat = None,
    focal: Focal = None,
    quality: QualityOption = None,
    views: Views = None,
    select: Select = None,
    size: Size = None,
    crop: Crop = False,
    refine: Refine = None,
    max_gaussians: MaxGaussians = 0,
    near: Near = None,
    far: Far = None,
    offset: Offset = None,
    exposure: Exposure = ExposureMode.AUTO,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    min_opacity: MinOpacity = 0,
    crop_border: CropBorder = 0,
    max_depth_jump: DepthJump = 0,
    min_consistency: MinConsistency = 0,
    remove_contradicted: RemoveContradicted = False,
    merge_duplicates: MergeDuplicates = False,
    close_holes: CloseHoles = False,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Reconstruct many scenes; the same command again does what is missing or changed, and nothing else.

    Prints one line of JSON for each scene, or, on a terminal, progress. The exit status is 3 where some failed.
    """
    from ..batch.places import join, parse_place
    from ..batch.run import batch as run_batch
    from ..batch.run import index_name, summary_name
    from ..batch.scenes import FILTERS
    from ..images.sizes import parse_size
    from ..inference.inputs import parse_views
    from ..system.outputs import outputs

    session = session_config(threads, device, provider_option)
    options: dict[str, Any] = {
        "camera_format": camera_format,
        "focal": focal,
        "quality": quality,
        "views": parse_views(views) if views else None,
        "select": select,
        "size": parse_size(size) if size else None,
        "crop": crop,
        "refine": refine,
        "max_gaussians": max_gaussians,
        "near": near,
        "far": far,
        "offset": offset,
        "exposure": None if exposure == ExposureMode.AUTO else exposure,
        "min_opacity": min_opacity,
        "crop_border": crop_border,
        "max_depth_jump": max_depth_jump,
        "min_consistency": min_consistency,
        "remove_contradicted": remove_contradicted,
        "merge_duplicates": merge_duplicates,
        "close_holes": close_holes,
    }
    unset = {*FILTERS, "crop", "max_gaussians"}  # options that 0 or false leave off
    on_terminal = sys.stdout.isatty()  # asked before there is progress, which takes the stream
    target = parse_place(out)
    summary_place, page = join(target, summary_name(shard)), join(target, index_name(shard))
    if isinstance(summary_place, Path) and isinstance(page, Path):
        known = _is_summary(summary_place)
        outputs().writes("--out", [summary_place, page], known=known)
    summary = run_batch(
        scenes,
        out,
        engine=engine,
        address=address,
        model=model,
        splat_format=splat_format,
        options={name: value for name, value in options.items() if value is not None and (value or name not in unset)},
        workers=workers,
        provider=provider,
        session=session,
        shard=shard,
        retry_failed=retry_failed,
        max_failures=max_failures,
        cache_gb=cache_size,
        overwrite=overwrite,
        on_record=_tell_failure if on_terminal else _tell_line,
    )
    if on_terminal:
        pace = f" in {summary.seconds:.1f} s, {60 * summary.tried / summary.seconds:.3g} scenes/min"
        note(f"{summary.tried} tried{pace if summary.tried else ''}; {summary.describe()}: {summary_place}")
        note(f"open {page} in any browser; `idesplat view {out}/ID/scene.{splat_format}` shows a scene")
    if summary.failed:
        raise typer.Exit(SOME_FAILED)


def main() -> None:
    """Run the command."""
    run(batch)


def _tell_line(record: dict[str, Any]) -> None:
    """One line of JSON for a scene."""
    say(json.dumps(record))


def _tell_failure(record: dict[str, Any]) -> None:
    """On a terminal, where there is progress, only the error of a failure."""
    if "error" in record:
        warn(f"{record['id']}: {record['error']}")


def _is_summary(path: Path) -> bool:
    """Whether a file is what an earlier run has written, maybe on another machine."""
    from ..batch.run import Summary

    try:
        return set(json.loads(path.read_bytes())) == set(Summary.__dataclass_fields__)
    except (OSError, ValueError, TypeError, RecursionError):
        return False
