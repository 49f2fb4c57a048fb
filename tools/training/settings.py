"""The settings of a training run, and the network configuration that belongs to them."""

from dataclasses import dataclass

from ...model.idesplat.config import IDESplatConfig
from ...model.registry import PRESETS
from ...runtime.errors import InputError
from .options import INPUT_VIEWS, TARGET_ZOOM, Objective, OptionalTerms, Part, TargetViews
from .schedule import Phase, training_phases

# The ViT and the downsampling levels of its head need more than one patch of 14 pixels a side.
MIN_SIZE_MULTIPLE = 32


@dataclass(frozen=True)
class TrainingSettings:
    """All that decides a run's result. A checkpoint stores it, and resumes only with the same values.

    preset: an IDESplat preset. objective, part, precision, perceptual: values of the enums in `options`.
    curriculum: whether depth is trained from coarse to fine before the Gaussians. steps: of the whole run.
    batch: scenes of a step. size: side of the images in the last phase, in pixels. lr, vit_lr, photo_lr: highest
    learning rates; a photo_lr of 0 leaves EfficientNet-Lite0 frozen. seed: of weights and scenes.
    init: a checkpoint to start from, or empty. data: folders of captures.
    scenes: number of different scenes if the head alone is trained, otherwise 0. real_ratio: share of the scenes that
    are captures. textures: folder of images for the textures of synthetic scenes, or empty. pm_loss, consistency,
    aperture: as of `OptionalTerms`. pointmaps: folder of the captures' pointmaps, or empty. target_zoom, input_views:
    as of `TargetViews`; None is the number of `INPUT_VIEWS` for the part.
    """

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
    pm_loss: float = 0.0
    pointmaps: str = ""
    consistency: float = 0.0
    aperture: float = 0.0
    photo_lr: float = 0.0
    target_zoom: int = TARGET_ZOOM
    input_views: int | None = None

    @property
    def terms(self) -> OptionalTerms:
        """The optional terms of the loss."""
        return OptionalTerms(self.pm_loss, self.consistency, self.aperture)

    @property
    def targets(self) -> TargetViews:
        """The views that are rendered."""
        inputs = INPUT_VIEWS[Part(self.part)] if self.input_views is None else self.input_views
        return TargetViews(self.target_zoom, inputs)

    @property
    def phases(self) -> tuple[Phase, ...]:
        """The phases of the run."""
        if self.part == Part.HEAD:
            return training_phases(Objective.PHOTOMETRIC, curriculum=False)
        return training_phases(Objective(self.objective), self.curriculum)

    @property
    def renders(self) -> bool:
        """Whether novel views are rendered in some phase."""
        return any(phase.gaussians for phase in self.phases)


def network_config(settings: TrainingSettings) -> IDESplatConfig:
    """The preset's configuration; raises InputError for settings that contradict each other or the preset."""
    presets = {name: config for name, config in PRESETS.items() if isinstance(config, IDESplatConfig)}
    if settings.preset not in presets:
        raise InputError(f"--preset {settings.preset}: no such preset; choose one of {', '.join(presets)}")
    if settings.part == Part.HEAD and not settings.init:
        raise InputError("--train head: there is no head to train yet; give a checkpoint with --init")
    only_captures = settings.data and settings.real_ratio == 1
    if only_captures and settings.part != Part.HEAD and settings.objective != Objective.PHOTOMETRIC:
        raise InputError(
            f"--objective {settings.objective}: captures have no true depth; use photometric, or --real-ratio"
        )
    _check_terms(settings)
    config = presets[settings.preset]
    largest = max(phase.downsample for phase in settings.phases)
    multiple = largest * max(config.size_multiple, MIN_SIZE_MULTIPLE)
    if settings.size % multiple:
        raise InputError(f"--size {settings.size}: must be a multiple of {multiple} for this preset and these phases")
    return config


def _check_terms(settings: TrainingSettings) -> None:
    """Raise InputError if an optional term of the loss, or a choice of the rendered views, could have no effect."""
    given = {"--pm-loss": settings.pm_loss, "--consistency": settings.consistency, "--lens-diameter": settings.aperture}
    used = [option for option, value in given.items() if value]
    if used and settings.part == Part.HEAD:
        raise InputError(f"{used[0]}: trains depth, which --train head leaves as it is; leave one of them out")
    if settings.target_zoom != TARGET_ZOOM:
        used.append("--target-zoom")
    if settings.input_views is not None:
        used.append("--input-views")
    if used and not settings.renders:
        raise InputError(f"{used[0]}: needs Gaussians, which --objective depth does not train; use another objective")
    if settings.pointmaps and not (settings.pm_loss and settings.data):
        raise InputError("--pointmaps: are those of captures for PM-Loss; add --data and --pm-loss, such as 0.005")
    if settings.pm_loss and settings.data and settings.real_ratio == 1 and not settings.pointmaps:
        raise InputError("--pm-loss: captures have no true points; add --pointmaps, or --real-ratio below 1")
    if settings.aperture and not (settings.data and settings.real_ratio):
        raise InputError("--lens-diameter: is that of captures; add --data, with --real-ratio above 0")
