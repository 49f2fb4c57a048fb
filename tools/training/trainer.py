"""The training loop.

The scenes of a step depend on the run's seed and the step's number alone, so that a resumed run repeats an
uninterrupted one.
"""

import ctypes
import math
import sys
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.gaussian_head import HeadInputs
from ...model.idesplat.network import IDESplat
from ...runtime.errors import InputError
from ..perceptual import EfficientNetDistance, Perceptual, load_lpips
from ..synthetic.photo_textures import photo_textures
from .capture_validation import CaptureValidation
from .convolutions import use_channels_last
from .data.captures import CaptureScenes
from .data.samples import SampleSpec, TrainingViews, prefetch, prefetch_in_processes
from .data.synthetic import generate_views
from .head import FeatureCache
from .log import TrainingLog, finite
from .mixed_precision import with_bfloat16
from .objectives.consistency import with_matches
from .options import Device, Objective, Part, PerceptualKind, Precision, Resources
from .parallel import ProcessGroup, mean_entries, spawn_workers
from .plots import write_curves
from .run_files import CHECKPOINT, CURVES, FEATURES, LOG, PREDICTIONS
from .schedule import Phase, lr_factor, phase_at
from .settings import TrainingSettings, network_config
from .state import TrainingState
from .tasks import FullNetworkTask, HeadTask, TrainingTask
from .validation import validate

# Called with what is logged of each step: `step`, `loss` and metrics.
OnStep = Callable[[dict[str, Any]], None]
Source = Callable[[SampleSpec], TrainingViews]

ONE_THREAD = Resources()
# The name in the log of the mean PSNR of the validation captures.
CAPTURES_PSNR = "captures_psnr"
PLOTTED = (
    *("loss", "psnr", "input_psnr", "abs_rel"),
    *("validation_abs_rel", "validation_psnr", CAPTURES_PSNR, "gradient"),
)
# glibc returns the memory of every large tensor to the system, which clears it again on the next allocation. These
# parameters of mallopt make it keep that memory.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
MAX_THRESHOLD = 2**31 - 1


def train(
    settings: TrainingSettings,
    out: Path,
    *,
    config: IDESplatConfig | None = None,
    features: Path | None = None,
    resources: Resources = ONE_THREAD,
    save_every: float = 180.0,
    validate_every: int = 200,
    captures: Path | None = None,
    on_start: Callable[[], None] | None = None,
    on_step: OnStep | None = None,
) -> None:
    """Train a network in the folder `out`, or resume the run whose checkpoint is there.

    config: the network's, if not that of the preset. features: folder of cached features, by default one inside `out`.
    save_every: seconds between checkpoints. validate_every: steps between validations. captures: folder of checkouts,
    whose validation captures are rendered at every validation. on_start: called once weights and data are loaded.
    on_step: called after each step. LPIPS is left out where it is not installed.

    Raises InputError for settings that contradict each other, for a checkpoint of another run, and for unusable data.
    """
    config = config or network_config(settings)
    _check_resources(resources, settings, config)
    processes = resources.processes
    trainer = Trainer(out, settings, config, features, ProcessGroup(0, processes), resources, captures)
    if on_start is not None:
        on_start()
    with spawn_workers(processes, _work, out, settings, config, features, resources, validate_every):
        trainer.fit(save_every, validate_every, on_step)


def _work(
    group: ProcessGroup,
    folder: Path,
    settings: TrainingSettings,
    config: IDESplatConfig,
    features: Path | None,
    resources: Resources,
    validate_every: int,
) -> None:
    """The loop of a process other than rank 0."""
    Trainer(folder, settings, config, features, group, resources).fit(math.inf, validate_every)


class Trainer:
    """A training run in its folder."""

    def __init__(
        self,
        folder: Path,
        settings: TrainingSettings,
        config: IDESplatConfig,
        features: Path | None = None,
        group: ProcessGroup | None = None,
        resources: Resources = ONE_THREAD,
        captures: Path | None = None,
    ) -> None:
        """Start the run, or resume it from the checkpoint in the folder; raises InputError if that is another run's.

        features: folder of cached features, by default one inside `folder`. group: the processes of the run.
        captures: folder of checkouts of the validation captures that this process renders, too.
        """
        _prepare_process(resources.threads)
        self.folder, self.settings, self.group = folder, settings, group or ProcessGroup()
        trained = HeadTask.trained if settings.part == Part.HEAD else FullNetworkTask.trained
        rates = settings.lr, settings.vit_lr, settings.photo_lr
        self.state = TrainingState(config, settings.seed, *rates, trained, resources.device)
        resumed = (folder / CHECKPOINT).exists()
        if resumed:
            self.state.resume(folder / CHECKPOINT, asdict(settings))
        elif settings.init:
            self.state.start_from(Path(settings.init))
        self.captures = CaptureValidation(captures, settings, config) if captures else None
        self.source, self.held_out = _sources(settings, config)
        if settings.consistency:
            self.source = partial(with_matches, self.source)
        self.task = _task(settings, self.state.model, self.source, features or folder / FEATURES, resources.together)
        self.loaders = resources.loaders
        self.phases = self.task.phases
        if resources.device is Device.CPU:
            use_channels_last(self.state.model)
        if settings.precision == Precision.BF16:
            with_bfloat16(self.state.model)
        if not resumed:
            self.task.prepare(self.state.model)
            self.state.reset_ema()
        self.log = TrainingLog(folder / LOG, self.state.step) if self.group.is_main else None

    def fit(self, save_every: float, validate_every: int, on_step: OnStep | None = None) -> None:
        """Train to the last step. save_every: seconds, from the first step on. validate_every: steps."""
        saved = -math.inf
        with closing(self.samples()) as samples:
            while self.state.step < self.settings.steps:
                entry = self.train_step(samples)
                if self.log is None:
                    continue
                validated = self.state.step % validate_every == 0 or self.state.step == self.settings.steps
                if validated:
                    entry |= self.validate()
                self.log.add(entry)
                if validated:
                    write_curves(self.folder / CURVES, self.log.entries, PLOTTED)
                if on_step is not None:
                    on_step(entry)
                if time.monotonic() - saved >= save_every:
                    self.save()
                    saved = time.monotonic()
        if self.group.is_main:
            self.save()

    def phase(self, step: int) -> Phase:
        """The phase of a step, counted from 0."""
        return phase_at(self.phases, step, self.settings.steps)

    def specs(self) -> Iterator[SampleSpec]:
        """This process's samples of all steps that are left."""
        for step in range(self.state.step, self.settings.steps):
            for slot in self.group.shard(self.settings.batch):
                yield self.task.spec(step, slot, self.phase(step))

    def samples(self) -> Generator[Any]:
        """This process's samples of all steps that are left, loaded ahead of their use. To be closed."""
        if self.loaders:
            return prefetch_in_processes(list(self.specs()), self.source, self.loaders)
        return prefetch(self.specs(), self.task.load)

    def train_step(self, samples: Iterator[Any]) -> dict[str, Any]:
        """Accumulate the gradients of a batch and make an optimiser step; returns what is logged."""
        started = time.monotonic()
        phase, batch = self.phase(self.state.step), self.settings.batch
        entries = []
        for part in self._parts(samples, phase):
            loss, entry = self.task.loss(self.state.model, part, self.state.step, phase)
            (loss * len(part) / batch).backward()
            entries += [entry] * len(part)
        self.group.all_reduce_gradients(self.state.model.parameters())
        norm = self.state.update(lr_factor(self.phases, self.state.step, self.settings.steps))
        means = {name: finite(value) for name, value in mean_entries(self.group.gather(entries)).items()}
        seconds = round(time.monotonic() - started, 3)
        return {"step": self.state.step, **means, "gradient": finite(norm), "seconds": seconds}

    def _parts(self, samples: Iterator[Any], phase: Phase) -> Iterator[list[Any]]:
        """This process's samples of a step, as many at a time as the network takes at once."""
        left = len(self.group.shard(self.settings.batch))
        while left:
            first = next(samples)
            others = min(left, self.task.at_once(self.state.model, first, phase)) - 1
            yield [first, *islice(samples, others)]
            left -= 1 + others

    def validate(self) -> dict[str, Any]:
        """Metrics of the EMA network on validation scenes at the phase's size; writes their predictions.

        Validation captures are rendered at the run's size in every phase.
        """
        phase, model = self.phase(self.state.step - 1), self.state.ema_model()
        side = self.settings.size // phase.downsample
        found = validate(model, phase, side, self.held_out, self.folder / PREDICTIONS)
        if self.captures is not None:
            found[CAPTURES_PSNR] = self.captures.mean_psnr(model)
        return {name: finite(value) for name, value in found.items()}

    def save(self) -> None:
        """Write the checkpoint atomically."""
        self.state.save(self.folder / CHECKPOINT, asdict(self.settings))


def _sources(settings: TrainingSettings, config: IDESplatConfig) -> tuple[Source, Source]:
    """Loaders of the training and of the validation samples: synthetic scenes, captures, or both."""
    photos = Path(settings.textures) if settings.textures else None
    if photos is not None:
        photo_textures(photos)
    synthetic = partial(generate_views, photos=photos)
    if not settings.data:
        return synthetic, synthetic
    pointmaps = Path(settings.pointmaps) if settings.pointmaps else None
    captures = CaptureScenes([Path(folder) for folder in settings.data], config.near, config.far, pointmaps)
    if settings.real_ratio == 1:
        return captures.load, captures.load_held_out
    return partial(_either, captures.load, synthetic), synthetic


def _either(real: Source, synthetic: Source, spec: SampleSpec) -> TrainingViews:
    """The views of a sample of either kind."""
    return real(spec) if spec.real else synthetic(spec)


def _task(
    settings: TrainingSettings, model: IDESplat, source: Source, features: Path, together: int
) -> TrainingTask[Any]:
    """The task that the settings describe. features: folder of cached features."""
    size, batch = settings.size, settings.batch
    perceptual = _perceptual(settings, next(model.parameters()).device) if settings.renders else None
    if settings.part == Part.HEAD:
        sources = settings.data, settings.textures, settings.target_zoom
        description = repr((size, *sources, settings.precision, HeadInputs._fields))
        cache = FeatureCache(features, model, source, description)
        return HeadTask(
            cache,
            settings.seed,
            size,
            batch,
            settings.scenes,
            settings.real_ratio,
            settings.targets,
            perceptual,
        )
    objective = Objective(settings.objective)
    return FullNetworkTask(
        settings.phases,
        objective,
        settings.seed,
        size,
        source,
        settings.real_ratio,
        settings.targets,
        perceptual,
        settings.terms,
        together,
    )


def _perceptual(settings: TrainingSettings, device: torch.device) -> Perceptual | None:
    """The perceptual distance of the settings; None also if that is LPIPS, and LPIPS is not installed."""
    if settings.perceptual == PerceptualKind.LITE0:
        return EfficientNetDistance(device)
    if settings.perceptual == PerceptualKind.NONE:
        return None
    try:
        return load_lpips(device)
    except InputError:
        return None


def _check_resources(resources: Resources, settings: TrainingSettings, config: IDESplatConfig) -> None:
    """Raise InputError for resources that are not there, or that what is trained cannot use."""
    processes, device, loaders = resources.processes, resources.device, resources.loaders
    head = settings.part == Part.HEAD
    if processes > settings.batch:
        raise InputError(f"--processes {processes}: more than the {settings.batch} scenes of a step; raise --batch")
    if device is not Device.CPU and head:
        raise InputError(f"--device {device}: --train head runs on the CPU, with cached features; leave out --device")
    if device is not Device.CPU and (settings.pm_loss or settings.aperture):
        term = "--pm-loss" if settings.pm_loss else "--lens-diameter"
        raise InputError(f"--device {device}: {term} is computed on the CPU alone; leave one of them out")
    if device is not Device.CPU and not torch.cuda.is_available():
        raise InputError(f"--device {device}: PyTorch {torch.__version__} finds no such GPU; leave out --device")
    if resources.together > 1 and settings.data:
        raise InputError(
            f"--together {resources.together}: takes synthetic scenes alone; leave out --together or --data"
        )
    if resources.together > 1 and config.photo is None:
        raise InputError(f"--together {resources.together}: the ViT takes one scene at a time; leave out --together")
    if loaders and processes > 1:
        raise InputError(f"--loaders {loaders}: need a single process that trains; leave out --processes or --loaders")
    if loaders and head:
        raise InputError(f"--loaders {loaders}: --train head has its scenes cached; leave out --loaders")


def _prepare_process(threads: int) -> None:
    """Configure PyTorch and the C library of this process."""
    _keep_freed_memory()
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)


def _keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next step; elsewhere do nothing."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        for parameter in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            mallopt(parameter, MAX_THRESHOLD)
