"""The command `idesplat eval`: metrics of an exported model on held-out views."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ...runtime.cli.input_files import camera_files, model_files
from ...runtime.cli.options import (
    CAMERAS_HELP,
    Config,
    Device,
    Exposure,
    Far,
    Model,
    Near,
    Overwrite,
    Provider,
    ProviderOption,
    QualityOption,
    Quiet,
    Refine,
    RemoveContradicted,
    Size,
    Threads,
    Verbose,
)
from ...runtime.cli.outputs import command
from ...runtime.cli.session_options import session_config
from ...runtime.cli.terminal import run, say, warn
from ...runtime.errors import InputError
from ...runtime.images.naming import name_files
from ...runtime.images.sizes import parse_size
from ...runtime.inference.named_models import find_model
from ...runtime.system.output_names import IMAGE, RESULTS, strip_file
from ...runtime.system.outputs import outputs
from ...runtime.views.exposure_mode import ExposureMode
from .defaults import CONTEXT_VIEWS, HELD_OUT_SCENES, HOLD_OUT_EVERY, VIEW_COUNTS

if TYPE_CHECKING:  # nothing heavy is loaded before there is something to evaluate
    import numpy as np

    from .evaluate import Evaluation
    from .novel_views import Result

# Scenes whose strips `chunks` and `synthetic` write.
SCENES_WITH_STRIPS = 8

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for results.json and images.", show_default=False)]

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)


@app.command()
@command("idesplat eval scene")
def scene(
    images: Annotated[Path, typer.Argument(help="Folder of images.", show_default=False)],
    cameras: Annotated[Path, typer.Option("--cameras", "-c", help=CAMERAS_HELP, show_default=False)],
    out: Out,
    model: Model = None,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    context: Annotated[list[str] | None, typer.Option(help="An image to infer from; give two or more.")] = None,
    hold_out: Annotated[list[str] | None, typer.Option(help="An image to hold out; give one or more.")] = None,
    views: Annotated[
        int | None, typer.Option(help="Images around each target, without --context; 2 by default.", min=2)
    ] = None,
    hold_out_every: Annotated[
        int, typer.Option(help="Hold out images 0, N, 2 N and on, without --hold-out.", min=2)
    ] = HOLD_OUT_EVERY,
    true_depth: Annotated[Path | None, typer.Option(help="Folder of true depth, as make_scene writes it.")] = None,
    size: Size = None,
    near: Near = None,
    far: Far = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Evaluate on images with cameras: hold some out, infer from others, and compare."""
    if views is not None and context:
        raise InputError("--views and --context: expected one of them; --context names the views that there are")
    from ...runtime.cameras.io import read_cameras
    from ...runtime.images.finding import find_images
    from .evaluate import ModelOn, evaluate
    from .report import print_means, print_views

    found = find_images([images])
    known = read_cameras(cameras, found)
    session = session_config(threads, device, provider_option)
    _check_outputs(model, out, [*found, *camera_files(cameras)])
    result = evaluate(
        found,
        known,
        ModelOn(find_model(model), provider, session),
        context=context or [],
        targets=hold_out or [],
        views=views,
        hold_out_every=hold_out_every,
        depth=true_depth,
        size=parse_size(size) if size else None,
        near=near,
        far=far,
        on_scene=StripWriter(out),
    )
    for case in result.scenes:
        say(f"held out {', '.join(view.name for view in case.targets)}, inferred from {', '.join(case.context)}")
    print_views(result.scenes)
    print_means(result.mean, f"{sum(len(case.targets) for case in result.scenes)} views held out, {_by(result.size)}")
    _write(out, {"command": "scene", "images": str(images)}, result)


@app.command()
@command("idesplat eval chunks")
def chunks(
    folder: Annotated[Path, typer.Argument(help="Folder of .torch chunks.", show_default=False)],
    index: Annotated[Path, typer.Option(help="The published evaluation index (.json).", show_default=False)],
    out: Out,
    model: Model = None,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    near: Near = None,
    far: Far = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Evaluate on RealEstate10K, ACID or DL3DV as the papers do: pixelSplat's chunks, a published index of frames."""
    from .chunks import find_chunks, read_index
    from .evaluate import ModelOn, evaluate_chunks
    from .report import print_means

    entries = read_index(index)
    session = session_config(threads, device, provider_option)
    _check_outputs(model, out, [index, *find_chunks(folder)])
    result = evaluate_chunks(
        folder,
        index,
        ModelOn(find_model(model), provider, session),
        near=near,
        far=far,
        on_scene=StripWriter(out, SCENES_WITH_STRIPS),
    )
    for key, reason in result.skipped.items():
        say(f"skipped {key}: {reason}")
    print_means(result.mean, f"{len(result.scenes)} of the index's {len(entries)} scenes, {_by(result.size)}")
    if result.missing:
        say(f"{result.missing} of the index's scenes are not in {folder}")
    _write(out, {"command": "chunks", "index": str(index)}, result)


@app.command()
@command("idesplat eval synthetic")
def synthetic(
    out: Out,
    model: Model = None,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    scenes: Annotated[
        int, typer.Option(help="How many of the held-out scenes.", min=1, max=HELD_OUT_SCENES)
    ] = HELD_OUT_SCENES,
    views: Annotated[int, typer.Option(help="Context views of each scene.", min=2, max=8)] = CONTEXT_VIEWS,
    pool_views: Annotated[
        int | None,
        typer.Option(help="Render this many context views and give --views of them, to compare numbers of views."),
    ] = None,
    size: Size = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Evaluate on the held-out synthetic scenes: depth against the truth, and novel views (extra `eval`)."""
    from .evaluate import ModelOn, evaluate_synthetic
    from .report import print_means

    session = session_config(threads, device, provider_option)
    _check_outputs(model, out, [])
    result = evaluate_synthetic(
        ModelOn(find_model(model), provider, session),
        scenes=scenes,
        views=views,
        pool_views=pool_views,
        size=parse_size(size) if size else None,
        on_scene=StripWriter(out, SCENES_WITH_STRIPS),
    )
    pool = pool_views or views
    print_means(result.mean, f"{scenes} held-out synthetic scenes, {views} of {pool} views, {_by(result.size)}")
    _write(out, {"command": "synthetic", "views": views, "pool_views": pool}, result)


@app.command()
@command("idesplat eval captures")
def captures(
    out: Out,
    checkouts: Annotated[
        Path | None,
        typer.Option(help="Folder of checkouts, each OWNER+NAME or OWNER/NAME; missing ones are cloned into it."),
    ] = None,
    capture: Annotated[list[str] | None, typer.Option(help="Measure this capture alone; may be repeated.")] = None,
    views: Annotated[str, typer.Option(help="Numbers of context views, with commas; 2 are the triples.")] = ",".join(
        map(str, VIEW_COUNTS)
    ),
    quality: QualityOption = None,
    refine: Refine = None,
    exposure: Exposure = ExposureMode.AUTO,
    remove_contradicted: RemoveContradicted = False,
    model: Model = None,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    size: Size = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Evaluate on real captures at pinned commits of public repositories, cloned where they are not given (git)."""
    from ...runtime.images.png import save_png
    from ...runtime.splats.filtering import FilterOptions
    from .captures.capture import parse_view_counts
    from .captures.report import print_captures, write_capture_results
    from .evaluate import ModelOn, evaluate_captures

    counts = parse_view_counts(views)
    session = session_config(threads, device, provider_option)
    _check_outputs(model, out, [])
    result = evaluate_captures(
        checkouts,
        ModelOn(find_model(model), provider, session),
        captures=capture or [],
        view_counts=counts,
        quality=quality,
        refine=refine,
        exposure=exposure,
        filters=FilterOptions(remove_contradicted=remove_contradicted),
        size=parse_size(size) if size else None,
        on_target=lambda name, strip: save_png(out / f"{name}{IMAGE}", strip),
    )
    for warning in result.warnings:
        warn(f"warning: {warning}")
    print_captures(result.captures, counts, _by(result.size))
    path = write_capture_results(out, result)
    say(f"wrote {path}")
    say(f"strips (truth, render, error, depth, and for triples the oracle plane) are beside it in {out}")


def main() -> None:
    """Entry point of idesplat eval."""
    run(app)


class StripWriter:
    """Writes the strips of the first scenes into a folder; most: how many scenes, or None for all."""

    def __init__(self, folder: Path, most: int | None = None) -> None:
        self.folder, self.most, self.scenes = folder, most, 0

    def __call__(self, result: "Result", strips: "dict[str, np.ndarray]") -> None:
        """Write a scene's strips as SCENE-TARGET.png."""
        from ...runtime.images.png import save_png

        if self.most is None or self.scenes < self.most:
            for name, strip in zip(name_files(list(strips)), strips.values(), strict=True):
                save_png(strip_file(self.folder, result.name, name), strip)
        self.scenes += 1


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _check_outputs(model: Path | None, out: Path, data: Sequence[Path]) -> None:
    """Check before the model is loaded that the results can be written, and replace no input and no file of the user's.

    Strips are named after scenes, which may not be known yet, so every .png in the folder counts as one to be replaced.
    """
    files = outputs()
    files.reads("the model", model_files(find_model(model)))
    files.reads("data", data)
    files.writes_into("--out", out)
    files.writes("--out", [out / RESULTS, *out.glob(f"*{IMAGE}")])


def _write(out: Path, options: dict[str, object], result: "Evaluation") -> None:
    """Write results.json, and say what was left out and where the strips are."""
    from .report import write_results

    for warning in result.warnings:
        warn(f"warning: {warning}")
    path = write_results(out, options, result)
    say(f"wrote {path}")
    say(f"strips (truth, render, error, depth, and the oracle plane where there is one) are beside it in {out}")
