"""The command `idesplat train`: it parses options, calls `trainer.train` and prints what was written."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from ...runtime.cli.options import Config, Overwrite, Quiet, Verbose
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say, warn
from ...runtime.errors import InputError
from ...runtime.images.sizes import parse_size
from ...runtime.system.outputs import outputs
from .options import (
    INPUT_VIEWS,
    TARGET_ZOOM,
    Device,
    Objective,
    Part,
    PerceptualKind,
    Precision,
    Resources,
)
from .run_files import CHECKPOINT, CURVES, LOG, PREDICTIONS

SECONDS_PER_MINUTE = 60
MIN_SIDE = 64
MAX_SEED = 2**63 - 1
# Captures are resized to so many times the size of the context images, which takes memory.
MAX_TARGET_ZOOM = 8
# What the progress bar shows of a step, by its name in the log.
SHOWN = {"loss": "loss", "abs_rel": "AbsRel", "psnr": "PSNR"}


@command("idesplat train")
def train(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run; a run in it is resumed.")],
    preset: Annotated[str, typer.Option(help="The network: an IDESplat preset.")] = "idesplat-tiny",
    init: Annotated[Path | None, typer.Option(help="Checkpoint to start from, released or own.")] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder with images and transforms.json, instead of synthetic scenes. Every eighth image is held "
            "out; where all scenes are captures, validation renders these. Can be repeated."
        ),
    ] = None,
    textures: Annotated[
        Path | None,
        typer.Option(help="Folder of images for the textures of synthetic scenes, in addition to generated textures."),
    ] = None,
    real_ratio: Annotated[
        float, typer.Option(help="Share of the scenes taken from --data; the others are synthetic.", min=0, max=1)
    ] = 1.0,
    part: Annotated[
        Part, typer.Option("--train", help="The whole network, or the Gaussian head of --init with depth frozen.")
    ] = Part.ALL,
    scenes: Annotated[
        int,
        typer.Option(help="With --train head: number of different scenes, each some 6 MB on disk at 256x256.", min=1),
    ] = 1000,
    features: Annotated[
        Path | None, typer.Option(help="With --train head: folder of cached features, by default inside --out.")
    ] = None,
    objective: Annotated[
        Objective, typer.Option(help="Supervision: true depth, rendered novel views, or both.")
    ] = Objective.BOTH,
    curriculum: Annotated[
        bool, typer.Option(help="Train coarse depth first, then finer depth, then Gaussians; otherwise all at once.")
    ] = True,
    steps: Annotated[int, typer.Option(help="Steps of the whole run.", min=1)] = 20000,
    batch: Annotated[int, typer.Option(help="Scenes per step.", min=1)] = 2,
    size: Annotated[
        str, typer.Option(help="HEIGHTxWIDTH of the images in the last phase, square; or one side.")
    ] = "256x256",
    lr: Annotated[float, typer.Option(help="Highest learning rate.", min=0)] = 1e-3,
    vit_lr: Annotated[float, typer.Option(help="Highest learning rate of the ViT.", min=0)] = 5e-4,
    photo_lr: Annotated[
        float,
        typer.Option(help="Highest learning rate of EfficientNet-Lite0; 0 leaves its weights as they are.", min=0),
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="Random seed of weights and scenes.", min=0, max=MAX_SEED)] = 0,
    perceptual: Annotated[
        PerceptualKind,
        typer.Option(help="Perceptual distance of rendered views: LPIPS (if installed), EfficientNet-Lite0, or none."),
    ] = PerceptualKind.LPIPS,
    target_zoom: Annotated[
        int,
        typer.Option(
            help="One target view is a crop of an image from 2 to so many times as large as the input images, one has "
            "their size; 1: both have it.",
            min=1,
            max=MAX_TARGET_ZOOM,
        ),
    ] = TARGET_ZOOM,
    input_views: Annotated[
        int | None,
        typer.Option(
            help="Input views that are rendered beside the novel ones; 0: novel views alone. By default "
            f"{INPUT_VIEWS[Part.ALL]}, with --train head {INPUT_VIEWS[Part.HEAD]}.",
            min=0,
            show_default=False,
        ),
    ] = None,
    pm_loss: Annotated[
        float, typer.Option(help="Weight of PM-Loss against true points or --pointmaps; 0.005 in the paper.", min=0)
    ] = 0.0,
    pointmaps: Annotated[
        Path | None,
        typer.Option(help="Folder of the captures' pointmaps, FOLDER/IMAGE.npy with [height, width, 3] points."),
    ] = None,
    consistency: Annotated[
        float, typer.Option(help="Weight of depth that agrees with points matched between views.", min=0)
    ] = 0.0,
    aperture: Annotated[
        float,
        typer.Option(
            "--lens-diameter", help="Diameter of the lens of captures with shallow focus; nearest depth is 1.", min=0
        ),
    ] = 0.0,
    precision: Annotated[
        Precision,
        typer.Option(help="Arithmetic of convolutions and attention; bf16 is faster on CPUs that support it."),
    ] = Precision.FLOAT32,
    processes: Annotated[int, typer.Option(help="Data-parallel processes, at most --batch.", min=1)] = 1,
    threads: Annotated[
        int,
        typer.Option(help="Threads per process. Generating scenes takes part of another.", min=1),
    ] = 1,
    device: Annotated[
        Device, typer.Option(help="Where the network is trained. The CPU renders scenes and Gaussians in any case.")
    ] = Device.CPU,
    together: Annotated[
        int,
        typer.Option(help="Scenes of two views that the network takes at once; more make a GPU faster.", min=1),
    ] = 1,
    loaders: Annotated[
        int, typer.Option(help="Processes that render scenes, if one process trains; 0 for a thread.", min=0)
    ] = 0,
    save_every: Annotated[float, typer.Option(help="Minutes between checkpoints.", min=0)] = 3.0,
    validate_every: Annotated[int, typer.Option(help="Steps between validations.", min=1)] = 200,
    validate_captures: Annotated[
        Path | None,
        typer.Option(
            help="Folder of checkouts as of idesplat eval captures. Every validation then renders a held-out image of "
            "each capture in it, too, and logs their mean PSNR."
        ),
    ] = None,
    overwrite: Overwrite = False,
    config_file: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Train IDESplat on synthetic scenes with exact depth and cameras, or on captures."""
    from .settings import TrainingSettings, network_config

    head = part is Part.HEAD
    settings = TrainingSettings(
        preset=preset,
        objective=objective.value,
        curriculum=curriculum and not head,
        steps=steps,
        batch=batch,
        size=_side(size),
        lr=lr,
        vit_lr=vit_lr,
        seed=seed,
        init=str(init.resolve()) if init else "",
        data=[str(folder.resolve()) for folder in data or []],
        part=part.value,
        scenes=scenes if head else 0,
        real_ratio=real_ratio,
        precision=precision.value,
        textures=str(textures.resolve()) if textures else "",
        perceptual=perceptual.value,
        pm_loss=pm_loss,
        pointmaps=str(pointmaps.resolve()) if pointmaps else "",
        consistency=consistency,
        aperture=aperture,
        photo_lr=photo_lr,
        target_zoom=target_zoom,
        # The part's own number is no other setting than none.
        input_views=None if input_views == INPUT_VIEWS[part] else input_views,
    )
    config = network_config(settings)
    _announce(out, init, data or [])
    outputs().make_folder(out)

    from ..perceptual import check_lpips
    from .trainer import train as train_network

    def warn_without_lpips() -> None:
        if perceptual is PerceptualKind.LPIPS and settings.renders:
            try:
                check_lpips()
            except InputError as missing:
                warn(f"warning: {missing}")

    with _progress_bar(steps, quiet) as on_step:
        train_network(
            settings,
            out,
            config=config,
            features=features,
            resources=Resources(processes, threads, device, together, loaders),
            save_every=save_every * SECONDS_PER_MINUTE,
            validate_every=validate_every,
            captures=validate_captures,
            on_start=warn_without_lpips,
            on_step=on_step,
        )
    say(
        f"{out / CHECKPOINT}: the trained network, for idesplat export; {out / LOG}: loss and metrics of every step",
        f"{out / CURVES}: curves; {out / PREDICTIONS}: image, truth, prediction and error of validation scenes",
    )


def _side(text: str) -> int:
    """The option --size, `256x256` or `256`, as the side in pixels; raises InputError."""
    height, width = parse_size(f"{text}x{text}" if text.isdecimal() else text)
    if height != width or height < MIN_SIDE:
        raise InputError(f"--size {text}: expected a square with sides of {MIN_SIDE} pixels at least, such as 256x256")
    return height


@contextmanager
def _progress_bar(steps: int, quiet: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A progress bar on stderr, if that is a terminal and not `quiet`; yields what is to be called after each step."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), disable=quiet or not sys.stderr.isatty()) as bar:

        def on_step(entry: dict[str, Any]) -> None:
            if not bar.tasks:  # a resumed run does not start at 0
                bar.add_task("training", total=steps, completed=entry["step"])
            shown = ((label, entry.get(name)) for name, label in SHOWN.items())
            description = ", ".join(f"{label} {value:.3f}" for label, value in shown if value is not None)
            bar.update(bar.tasks[0].id, completed=entry["step"], description=description)

        yield on_step


def _announce(out: Path, init: Path | None, data: list[Path]) -> None:
    """Register inputs and outputs; raises InputError if a run in `out` would replace an input or a file of the user.

    A checkpoint in `out` is resumed, which fails unless it is of this run; so the files beside it are of this run.
    """
    from ...runtime.cli.input_files import camera_files, given_images

    run = outputs()
    run.reads("the checkpoint to start from", [init] if init else [])
    for folder in data:
        run.reads("an image", given_images([folder, folder / "images"]))
        run.reads("the cameras", camera_files(folder))
    files = [out / name for name in (CHECKPOINT, LOG, CURVES, PREDICTIONS)]
    run.writes("--out", files, known=(out / CHECKPOINT).exists())


def main() -> None:
    """Run the command."""
    run(train)


if __name__ == "__main__":
    main()
