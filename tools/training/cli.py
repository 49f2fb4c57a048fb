"""The command that trains IDESplat on procedural scenes, from nothing or from a checkpoint.

Every step draws its scenes from the seed and the step's number alone, so that a run that was stopped goes on as if it
had not been.
"""

import ctypes
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...runtime.cli.outputs import Overwrite, guards_outputs, outputs
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError, exit_on_input_error
from .schedule import Objective, Part, PerceptualKind, Phase, Precision, lr_factor, phase_at, training_phases

if TYPE_CHECKING:  # torch and compiled code are loaded only once there is something to train
    from ...model.idesplat.config import IDESplatConfig
    from ...model.idesplat.network import IDESplat
    from .log import TrainingLog
    from .losses import Perceptual
    from .parallel import Team
    from .scenes import SampleSpec, Views
    from .tasks import TrainingTask

CHECKPOINT, LOG, CURVES, PICTURES = "last.ckpt", "log.jsonl", "curves.png", "predictions.png"
FEATURES = "features"
CURVES_SHOWN = ("loss", "psnr", "input_psnr", "abs_rel", "validation_abs_rel", "validation_psnr", "gradient")
SHOWN = {"loss": "loss", "AbsRel": "abs_rel", "PSNR": "psnr"}
# glibc's mallopt parameters: without them every large tensor's memory goes back to the system and is cleared again.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
LARGE = 2**31 - 1
# The ViT and the shrinking levels of its head want more than one patch of 14 pixels a side.
LEAST_SIDE = 32


@dataclass(frozen=True)
class Settings:
    """What decides a run's result; a checkpoint can only be resumed with the same."""

    preset: str
    objective: str
    curriculum: bool
    steps: int
    batch: int
    size: int
    lr: float
    vit_lr: float
    seed: int
    init: str
    data: list[str]
    part: str = "all"
    scenes: int = 0
    real_ratio: float = 1.0
    precision: str = "float32"
    textures: str = ""
    perceptual: str = "lpips"


@exit_on_input_error
@guards_outputs("idesplat-train")
def train(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, log and pictures; a run in it is resumed.")],
    preset: Annotated[str, typer.Option(help="The network, one of the IDESplat presets.")] = "idesplat-tiny",
    init: Annotated[Path | None, typer.Option(help="Checkpoint to start from, released or own.")] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder with photographs and transforms.json, instead of synthetic scenes; every eighth validates."
        ),
    ] = None,
    textures: Annotated[
        Path | None, typer.Option(help="Folder of images for the textures of synthetic scenes, beside generated ones.")
    ] = None,
    real_ratio: Annotated[
        float, typer.Option(help="Share of the scenes taken from --data; the others are synthetic.", min=0, max=1)
    ] = 1.0,
    part: Annotated[
        Part, typer.Option("--train", help="The whole network, or the Gaussian head of --init with depth frozen.")
    ] = Part.ALL,
    scenes: Annotated[
        int, typer.Option(help="With --train head: different scenes. Each takes some 6 MB of disk at 256x256.", min=1)
    ] = 1000,
    features: Annotated[
        Path | None, typer.Option(help="With --train head: folder of cached features, instead of one inside of --out.")
    ] = None,
    objective: Annotated[Objective, typer.Option(help="True depth, rendered novel views, or both.")] = Objective.BOTH,
    curriculum: Annotated[
        bool, typer.Option(help="Coarse depth first, then finer, then Gaussians; else everything from the start.")
    ] = True,
    steps: Annotated[int, typer.Option(help="Steps of the whole run.", min=1)] = 20000,
    batch: Annotated[int, typer.Option(help="Scenes of a step.", min=1)] = 2,
    size: Annotated[int, typer.Option(help="Side of the images in the last phase, in pixels.", min=64)] = 256,
    lr: Annotated[float, typer.Option(help="Highest learning rate.", min=0)] = 1e-3,
    vit_lr: Annotated[float, typer.Option(help="Highest learning rate of the ViT.", min=0)] = 5e-4,
    seed: Annotated[int, typer.Option(help="Of the weights and the scenes.", min=0)] = 0,
    perceptual: Annotated[
        PerceptualKind,
        typer.Option(help="Of rendered views: LPIPS where it is, EfficientNet-Lite0's features, or none."),
    ] = PerceptualKind.LPIPS,
    precision: Annotated[
        Precision, typer.Option(help="Of convolutions and attention; bfloat16 is quicker where the CPU has it.")
    ] = Precision.FLOAT32,
    processes: Annotated[int, typer.Option(help="Processes that share the scenes of a step.", min=1)] = 1,
    threads: Annotated[
        int, typer.Option(help="torch's threads in each process; drawing scenes takes a share of another.", min=1)
    ] = 1,
    save_every: Annotated[float, typer.Option(help="Minutes between checkpoints.", min=0)] = 3.0,
    validate_every: Annotated[int, typer.Option(help="Steps between validations.", min=1)] = 200,
    overwrite: Overwrite = False,
) -> None:
    """Train IDESplat on procedural scenes with exact depth and cameras, or on photographs."""
    start, folders = str(init.resolve()) if init else "", [str(folder.resolve()) for folder in data or []]
    head = part is Part.HEAD
    settings = Settings(
        preset,
        objective.value,
        curriculum and not head,
        steps,
        batch,
        size,
        lr,
        vit_lr,
        seed,
        start,
        folders,
        part.value,
        scenes if head else 0,
        real_ratio,
        precision.value,
        str(textures.resolve()) if textures else "",
        perceptual.value,
    )
    config = _config(settings)
    _announce(out, init, data or [])
    if processes > batch:
        raise InputError(f"--processes {processes}: more than the {batch} scenes of a step; raise --batch")
    from .parallel import Team, spawn_workers

    outputs().make_folder(out)
    training = Run(out, settings, config, features, Team(0, processes), threads)
    with spawn_workers(processes, _work, out, settings, config, features, threads, validate_every):
        training.go(save_every * 60, validate_every)


def _work(
    team: "Team",
    folder: Path,
    settings: Settings,
    config: "IDESplatConfig",
    features: Path | None,
    threads: int,
    validate_every: int,
) -> None:
    """What a process of a team does that does not lead it."""
    Run(folder, settings, config, features, team, threads).go(math.inf, validate_every)


class Run:
    """One training run in its folder."""

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        config: "IDESplatConfig",
        features: Path | None = None,
        team: "Team | None" = None,
        threads: int = 1,
    ) -> None:
        """Start it, or go on from the checkpoint in the folder; raises InputError if that is another run's.

        features: the folder of cached features, if not one inside of `folder`. team: of which this process is one.
        threads: torch's, in this process.
        """
        from .log import TrainingLog
        from .parallel import Team
        from .state import TrainingState

        _prepare_process(threads)
        self.folder, self.settings, self.team = folder, settings, team or Team()
        trained = _trained(settings)
        self.state: TrainingState = TrainingState(config, settings.seed, settings.lr, settings.vit_lr, trained)
        resumed = (folder / CHECKPOINT).exists()
        if resumed:
            self.state.resume(folder / CHECKPOINT, asdict(settings))
        elif settings.init:
            self.state.start_from(Path(settings.init))
        self.source: Callable[[SampleSpec], Views]
        self.held_out: Callable[[SampleSpec], Views]
        self.source, self.held_out = _sources(settings, config)
        self.task: TrainingTask[Any] = _task(settings, self.state.model, self.source, features or folder / FEATURES)
        self.phases = self.task.phases
        if not resumed:
            self.task.prepare(self.state.model)
            self.state.reset_ema()
        if settings.precision == Precision.BF16:
            from .mixed_precision import with_bfloat16

            with_bfloat16(self.state.model)
        self.log: TrainingLog | None = TrainingLog(folder / LOG, self.state.step) if self.team.leads else None

    def go(self, save_every: float, validate_every: int) -> None:
        """Train to the last step. save_every: seconds; validate_every: steps."""
        from .scenes import prefetch

        saved = time.monotonic()
        bar = Bar(self.settings.steps, self.state.step, shown=self.team.leads)
        with bar.progress:
            scenes = prefetch(self.specs(), self.task.load)
            while self.state.step < self.settings.steps:
                entry = self.train_step(scenes)
                if self.log is None:
                    continue
                if self.state.step % validate_every == 0 or self.state.step == self.settings.steps:
                    entry |= self.validate(self.log)
                self.log.add(entry)
                bar.show(entry)
                if time.monotonic() - saved >= save_every:
                    self.save()
                    saved = time.monotonic()
            scenes.close()
        if self.team.leads:
            self.save()
            folder = self.folder
            say(f"{folder / CHECKPOINT}: the trained network, for idesplat-export; {folder / LOG}: every step")
            say(f"{folder / CURVES} and {folder / PICTURES}: curves, and photograph, truth, prediction and error")

    def phase(self, step: int) -> Phase:
        """The phase of a step, counted from 0."""
        return phase_at(self.phases, step, self.settings.steps)

    def specs(self) -> "Iterator[SampleSpec]":
        """This process's scenes of every step from here on."""
        for step in range(self.state.step, self.settings.steps):
            for slot in self.team.share(self.settings.batch):
                yield self.task.spec(step, slot, self.phase(step))

    def train_step(self, scenes: Iterator[Any]) -> dict[str, Any]:
        """Gather the gradients of a batch and step along them; returns what is logged."""
        from .log import finite
        from .parallel import mean_entries

        started = time.monotonic()
        phase, batch = self.phase(self.state.step), self.settings.batch
        entries = []
        for _ in self.team.share(batch):
            loss, entry = self.task.loss(self.state.model, next(scenes), self.state.step, phase)
            (loss / batch).backward()
            entries.append(entry)
        self.team.all_reduce_gradients(self.state.model.parameters())
        norm = self.state.update(lr_factor(self.phases, self.state.step, self.settings.steps))
        means = {name: finite(value) for name, value in mean_entries(self.team.gather(entries)).items()}
        seconds = round(time.monotonic() - started, 3)
        return {"step": self.state.step, **means, "gradient": finite(norm), "seconds": seconds}

    def validate(self, log: "TrainingLog") -> dict[str, Any]:
        """Measure the mean network on validation scenes at the phase's size, and draw predictions and curves."""
        from .log import finite
        from .validation import validate

        phase = self.phase(self.state.step - 1)
        side = self.settings.size // phase.shrink
        found = validate(self.state.ema_model(), phase, side, self.held_out, self.folder / PICTURES)
        log.plot_curves(self.folder / CURVES, CURVES_SHOWN)
        return {name: finite(value) for name, value in found.items()}

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        self.state.save(self.folder / CHECKPOINT, asdict(self.settings))


class Bar:
    """What a user sees of the run: a bar on stderr where that is a terminal, else nothing."""

    def __init__(self, steps: int, done: int, shown: bool = True) -> None:
        """`steps`: of the whole run, `done`: when it was resumed, `shown`: False for none at all."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        self.progress = Progress(*columns, console=Console(stderr=True), disable=not (shown and sys.stderr.isatty()))
        self.task = self.progress.add_task("training", total=steps, completed=done)

    def show(self, entry: dict[str, Any]) -> None:
        """Bring the bar to a step that has been logged."""
        shown = ((label, entry.get(name)) for label, name in SHOWN.items())
        description = ", ".join(f"{label} {value:.3f}" for label, value in shown if value is not None)
        self.progress.update(self.task, completed=entry["step"], description=description)


def _config(settings: Settings) -> "IDESplatConfig":
    """The preset's configuration; raises InputError if there is none, or the size does not fit it."""
    from ...model.idesplat.config import IDESplatConfig
    from ...model.registry import PRESETS

    presets = {name: config for name, config in PRESETS.items() if isinstance(config, IDESplatConfig)}
    if settings.preset not in presets:
        raise InputError(f"--preset {settings.preset}: no such preset; choose one of {', '.join(presets)}")
    if settings.part == Part.HEAD and not settings.init:
        raise InputError("--train head: there is no head to train yet; give a checkpoint with --init")
    only_captures = settings.data and settings.real_ratio == 1
    if only_captures and settings.part != Part.HEAD and settings.objective != Objective.PHOTOMETRIC:
        raise InputError(
            f"--objective {settings.objective}: photographs have no true depth; use photometric, or --real-ratio"
        )
    config = presets[settings.preset]
    phases = training_phases(Objective(settings.objective), settings.curriculum)
    multiple = max(phase.shrink for phase in phases) * max(config.size_multiple, LEAST_SIDE)
    if settings.size % multiple:
        raise InputError(f"--size {settings.size}: must be a multiple of {multiple} for this preset and these phases")
    return config


def _announce(out: Path, init: Path | None, data: list[Path]) -> None:
    """Say what is read and written; raises InputError if a run in `out` would replace an input or a file of the user.

    A checkpoint in `out` is resumed, which fails unless it is this run's, and then so are the files beside it.
    """
    from ...runtime.cli.input_files import camera_files, given_images

    run = outputs()
    run.reads("the checkpoint to start from", [init] if init else [])
    for folder in data:
        run.reads("a photograph", given_images([folder, folder / "images"]))
        run.reads("the cameras", camera_files(folder))
    files = [out / name for name in (CHECKPOINT, LOG, CURVES, PICTURES)]
    run.writes("--out", files, known=(out / CHECKPOINT).exists())


def _sources(
    settings: Settings, config: "IDESplatConfig"
) -> "tuple[Callable[[SampleSpec], Views], Callable[[SampleSpec], Views]]":
    """What makes the views of training and of validation: synthetic scenes, the given folders, or both."""
    from ..synthetic.photo_textures import photo_textures
    from .scenes import generate_views

    photos = Path(settings.textures) if settings.textures else None
    if photos is not None:
        photo_textures(photos)
    synthetic = partial(generate_views, photos=photos)
    if not settings.data:
        return synthetic, synthetic
    from .captures import FolderScenes

    captures = FolderScenes([Path(folder) for folder in settings.data], config.near, config.far)
    if settings.real_ratio == 1:
        return captures.load, captures.load_held_out
    return (
        lambda spec: captures.load(spec) if spec.real else synthetic(spec),
        lambda spec: captures.load_held_out(spec) if spec.real else synthetic(spec),
    )


def _trained(settings: Settings) -> tuple[str, ...]:
    """The beginnings of the trained parameters' names."""
    from .tasks import FullNetworkTask, HeadTask

    return HeadTask.trained if settings.part == Part.HEAD else FullNetworkTask.trained


def _task(
    settings: Settings, model: "IDESplat", source: "Callable[[SampleSpec], Views]", features: Path
) -> "TrainingTask[Any]":
    """What the settings ask for; features: the folder of cached features."""
    from ...model.idesplat.gaussian_head import HeadInputs
    from .head import FeatureCache
    from .tasks import FullNetworkTask, HeadTask

    size, batch = settings.size, settings.batch
    if settings.part == Part.HEAD:
        cache = FeatureCache(
            features, model, source, repr((size, settings.data, settings.textures, HeadInputs._fields))
        )
        return HeadTask(cache, settings.seed, size, batch, settings.scenes, settings.real_ratio, _perceptual(settings))
    objective = Objective(settings.objective)
    phases = training_phases(objective, settings.curriculum)
    perceptual = _perceptual(settings) if any(phase.gaussians for phase in phases) else None
    return FullNetworkTask(phases, objective, settings.seed, size, source, settings.real_ratio, perceptual)


def _perceptual(settings: Settings) -> "Perceptual | None":
    """The perceptual distance that the settings ask for, where it can be had."""
    from .losses import load_perceptual
    from .perceptual import PhotographicDistance

    if settings.perceptual == PerceptualKind.LITE0:
        return PhotographicDistance()
    return load_perceptual() if settings.perceptual == PerceptualKind.LPIPS else None


def _prepare_process(threads: int) -> None:
    """Set what torch and the C library are to do in this process."""
    import torch

    _keep_memory()
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)


def _keep_memory() -> None:
    """Have glibc keep freed memory for the next step, where there is glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        for parameter in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            mallopt(parameter, LARGE)


def main() -> None:
    """Run the command."""
    run(train)


if __name__ == "__main__":
    main()
