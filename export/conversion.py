"""The steps of an export: load the checkpoint, trace it, verify the graphs against PyTorch, write the files."""

import logging
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from ..model.checkpoint import CheckpointError, file_sha256, fill, infer_preset, name_hash_warning, read_state_dict
from ..model.common.network import Network
from ..model.registry import PRESETS, build
from ..runtime.errors import InputError
from ..runtime.inference.metadata import ModelMetadata, StageFile, write_manifest
from ..runtime.system.files import make_folder
from ..runtime.system.progress import progress, working
from .existing_exports import replace_folder, working_folder
from .graph.external_data import check_weights, publish, save_model
from .stages import NamedTensors, Stage
from .targets import GraphSettings
from .tracing import DEFAULT_SETTINGS, Graphs, StaticShape, export_graphs
from .validation.compare import Exported, TensorError, verify

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedCheckpoint:
    """A network with a checkpoint's weights. sha256: of the file, in hex digits."""

    model: Network
    preset: str
    sha256: str


def load(checkpoint: Path, preset: str | None) -> LoadedCheckpoint:
    """Read a checkpoint as a preset, or as the one that its tensors and its name tell.

    Raises InputError if the preset is unknown, or the file is unsafe, unreadable, or fits no preset.
    """
    if preset is not None and preset not in PRESETS:
        raise InputError(f"--preset {preset}: no such preset; choose one of {', '.join(PRESETS)}")
    logger.info("reading %s", checkpoint)
    try:
        digest = file_sha256(checkpoint)
        warning = name_hash_warning(checkpoint, digest)
        if warning:
            logger.warning("%s", warning)
        tensors = read_state_dict(checkpoint)
        name = preset or infer_preset(checkpoint, tensors)
        model = build(name)
        fill(model, tensors, checkpoint)
    except CheckpointError as error:
        raise InputError(str(error)) from None
    count = sum(parameter.numel() for parameter in model.parameters())
    logger.info("preset %s, %s parameters", name, f"{count:,}")
    return LoadedCheckpoint(model.eval(), name, digest)


def build_metadata(
    model: Network,
    preset: str,
    checkpoint: str,
    digest: str,
    static: StaticShape,
    precision: str = "float32",
    target: str = "cpu",
) -> ModelMetadata:
    """The metadata of a network's graphs. checkpoint, digest: the name and the SHA-256 of the file of its weights."""
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
        target=target,
    )


def convert(
    model: Network,
    metadata: ModelMetadata,
    static: StaticShape,
    out: Path | None,
    staged: Path | None,
    settings: GraphSettings = DEFAULT_SETTINGS,
) -> tuple[list[TensorError], list[Path]]:
    """Trace, verify and write a network: the errors of every tensor in every case, and the files written.

    Without verification there are no errors. If any error exceeds its bound, nothing is written and the files are none.
    The work is done in folders beside the results, from where these are only moved: the system's folder for temporary
    files may lie in memory.
    """
    network = NamedTensors(model)
    with ExitStack() as stack:
        parents = dict.fromkeys(path.parent for path in (out, staged) if path is not None)
        folders = {parent: stack.enter_context(working_folder(parent)) for parent in parents}
        folder = next(iter(folders.values()))
        with working("tracing the network (a minute or so)"):
            graphs = export_graphs(network, metadata, static, make_folder(folder / "graphs"), settings)
        logger.info("traced: %s nodes, opset %s, %.0f MB", graphs.nodes, settings.opset, graphs.bytes / 1e6)
        logger.debug("stages: %s", ", ".join(stage.name for stage in graphs.stages))
        external = settings.external_data
        fused = []
        if out is not None:
            fused = save_model(graphs.whole, make_folder(folders[out.parent] / "fused") / out.name, external)
        new = make_folder(folders[staged.parent] / "staged") if staged else None
        stages = (
            _write_stages(graphs, new, external)
            if new
            else [(stage, graphs.of_stage(stage)) for stage in graphs.stages]
        )
        exported = Exported(stages, staged is not None, fused[0] if fused else None)
        errors = []
        if settings.verify:
            errors = list(progress(verify(network, exported, metadata, static), "verifying against PyTorch"))
        if not all(error.passed for error in errors):
            return errors, []
        logger.debug("verified %d tensors, comparing the weights", len(errors))
        if fused:
            check_weights(graphs.whole, fused[0])
        for stage, path in stages if staged else []:
            check_weights(graphs.of_stage(stage), path)
        files = publish(fused, out.parent) if out is not None else []
        if staged is not None and new is not None:
            replace_folder(new, staged)
            files.append(staged)
    logger.debug("published %s", ", ".join(map(str, files)))
    return errors, files


def _write_stages(graphs: Graphs, folder: Path, external: bool) -> list[tuple[Stage, Path]]:
    """Write one graph a stage and the manifest into an empty folder; the stages, each with its graph."""
    files = [
        StageFile(stage.name, f"{stage.name}.onnx", list(stage.inputs), list(stage.outputs)) for stage in graphs.stages
    ]
    for stage, file in zip(graphs.stages, files, strict=True):
        save_model(graphs.of_stage(stage), folder / file.file, external)
    write_manifest(folder, files)
    return [(stage, folder / file.file) for stage, file in zip(graphs.stages, files, strict=True)]
