"""The command idesplat-eval: metrics of an exported model on held-out views."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...runtime.cli.input_files import camera_files, model_files
from ...runtime.cli.outputs import Overwrite, guards_outputs, name_files, outputs
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError, exit_on_input_error
from ...runtime.images.sizes import parse_size
from ...runtime.inference.bundled_model import bundled_model
from ...runtime.system.files import scratch_folder
from ...runtime.system.progress import progress

if TYPE_CHECKING:  # nothing heavy is loaded before there is something to evaluate
    import numpy as np

    from ...runtime.cameras.camera import Camera
    from ...runtime.inference.predictor import Predictor
    from .cases import EvalCase
    from .novel_views import Evaluator, Result

# Scenes of which `chunks` and `procedural` leave images.
SCENES_WITH_IMAGES = 8
# Of a procedural scene.
TARGETS = 2
DEFAULT_VIEWS = 2
HELD_OUT_SCENES = 200

Skip = Callable[[str, str], None]
Out = Annotated[Path, typer.Option(help="Folder for results.json and images.", show_default=False)]
Model = Annotated[
    Path | None, typer.Option(help="A .onnx or staged folder of idesplat-export instead of the bundled model.")
]
Size = Annotated[str | None, typer.Option(help="HEIGHTxWIDTH to work at instead of the trained size.")]
Near = Annotated[float | None, typer.Option(help="Nearest depth in scene units.")]
Far = Annotated[float | None, typer.Option(help="Farthest depth in scene units.")]

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)


@app.command()
@exit_on_input_error
@guards_outputs("idesplat-eval")
def scene(
    images: Annotated[Path, typer.Argument(help="Folder of images.", show_default=False)],
    cameras: Annotated[Path, typer.Option(help="Their cameras, such as a transforms.json.", show_default=False)],
    out: Out,
    model: Model = None,
    context: Annotated[list[str] | None, typer.Option(help="A image to infer from; give two or more.")] = None,
    target: Annotated[list[str] | None, typer.Option(help="A image to hold out; give one or more.")] = None,
    views: Annotated[
        int | None, typer.Option(help="Images around each target, without --context; 2 by default.", min=2)
    ] = None,
    hold_out_every: Annotated[int, typer.Option(help="Hold out frames 0, N, 2 N and on, without --target.", min=2)] = 8,
    depth: Annotated[Path | None, typer.Option(help="Folder of true depth, as make_scene writes it.")] = None,
    size: Size = None,
    near: Near = None,
    far: Far = None,
    overwrite: Overwrite = False,
) -> None:
    """Hold images out, infer from others, and compare; beside the nearest image and the oracle plane."""
    if views is not None and context:
        raise InputError("--views and --context: expected one of them; --context names the views that there are")
    from ...runtime.cameras.io import read_cameras
    from ...runtime.images.io import find_images
    from ...runtime.views.batch import match_images_to_cameras
    from .image_folders import chosen_frames, load_case
    from .metrics import load_lpips
    from .novel_views import Evaluator, mean_of_views
    from .report import print_means, print_views

    found = find_images([images])
    frames = match_images_to_cameras(found, read_cameras(cameras, found))
    predictor = _runner(model, out, [*found, *camera_files(cameras)])
    count = predictor.model.view_count(views, None, DEFAULT_VIEWS) or DEFAULT_VIEWS
    chosen = chosen_frames(frames, context or [], target or [], count, hold_out_every)
    shape = parse_size(size) if size else predictor.model.size_for([camera for _, camera in frames])
    for sources, held_out in chosen:
        predictor.model.check_size(len(sources), *shape)
        say(f"held out {_names(frames, held_out)}, inferred from {_names(frames, sources)}")
    find_range = partial(predictor.depth_range, near=near, far=far)
    cases = (load_case(frames, *numbers, shape, find_range, depth) for numbers in chosen)
    results = _evaluate(cases, len(chosen), Evaluator(predictor, load_lpips()), out, with_images=len(chosen))
    means = mean_of_views(results)
    print_views(results)
    print_means(means, f"{sum(len(result.targets) for result in results)} views held out, {_by(shape)}")
    _write(out, {"command": "scene", "images": str(images), "size": shape}, predictor, means, results)


@app.command()
@exit_on_input_error
@guards_outputs("idesplat-eval")
def chunks(
    folder: Annotated[Path, typer.Argument(help="Folder of .torch chunks.", show_default=False)],
    index: Annotated[Path, typer.Option(help="The published evaluation index (.json).", show_default=False)],
    out: Out,
    model: Model = None,
    near: Near = None,
    far: Far = None,
    overwrite: Overwrite = False,
) -> None:
    """Evaluate on RealEstate10K, ACID or DL3DV as the papers do: pixelSplat's chunks, a published index of frames."""
    from .chunks import NEAR_PLANE_FACTOR, chunk_cases, find_chunks, read_index
    from .metrics import load_lpips
    from .novel_views import Evaluator, mean_of_scenes
    from .report import print_means

    entries, files = read_index(index), find_chunks(folder)
    predictor = _runner(model, out, [index, *files])
    own = predictor.metadata
    for views in sorted({len(entry.context) for entry in entries.values()}):
        predictor.model.check_size(views, own.height, own.width)
    shape = own.height, own.width
    near, far = near if near is not None else own.near, far if far is not None else own.far
    if not 0 < near < far:
        raise InputError(
            f"near {near:g} and far {far:g}: expected 0 < near < far; give --near and --far in scene units"
        )
    evaluator = Evaluator(predictor, load_lpips(), compare=False, near_plane=NEAR_PLANE_FACTOR * near)
    skipped: dict[str, str] = {}
    cases = chunk_cases(files, entries, shape, (near, far), skipped.__setitem__)
    results = _evaluate(cases, len(entries), evaluator, out, SCENES_WITH_IMAGES, skipped.__setitem__)
    for key, reason in skipped.items():
        say(f"skipped {key}: {reason}")
    missing = len(entries) - len(results) - len(skipped)
    if not results:
        raise InputError(
            f"{index}: of its {len(entries)} scenes {missing} are not in {folder} and {len(skipped)} cannot be used; "
            "give the chunks of the test set that the index was made for"
        )
    means = mean_of_scenes(results)
    print_means(means, f"{len(results)} of the index's {len(entries)} scenes, {_by(shape)}")
    if missing:
        say(f"{missing} of the index's scenes are not in {folder}")
    about = {"command": "chunks", "index": str(index), "size": shape, "skipped": skipped, "missing": missing}
    _write(out, about, predictor, means, results)


@app.command()
@exit_on_input_error
@guards_outputs("idesplat-eval")
def procedural(
    out: Out,
    model: Model = None,
    scenes: Annotated[
        int, typer.Option(help="How many of the held-out scenes.", min=1, max=HELD_OUT_SCENES)
    ] = HELD_OUT_SCENES,
    views: Annotated[int, typer.Option(help="Context views of each scene.", min=2, max=8)] = 2,
    pool_views: Annotated[
        int | None,
        typer.Option(help="Render this many context views and give --views of them, to compare numbers of views."),
    ] = None,
    size: Size = None,
    overwrite: Overwrite = False,
) -> None:
    """Evaluate on the held-out synthetic scenes: depth against the truth, and novel views (extra `eval`)."""
    if find_spec("numba") is None:
        raise InputError(
            "numba is needed to render synthetic scenes, and is not installed; pip install 'idesplat[eval]'"
        )
    from ..synthetic.sampler import HELD_OUT_SEEDS
    from .cases import procedural_case
    from .metrics import load_lpips
    from .novel_views import Evaluator, mean_of_scenes
    from .report import print_means

    predictor = _runner(model, out, [])
    shape = parse_size(size) if size else (predictor.metadata.height, predictor.metadata.width)
    predictor.model.check_size(views, *shape)
    pool = views if pool_views is None else pool_views
    if pool < views:
        raise InputError(f"--pool-views {pool}: expected at least the {views} of --views")
    cases = (procedural_case(seed, views, pool, TARGETS, *shape) for seed in HELD_OUT_SEEDS[:scenes])
    results = _evaluate(cases, scenes, Evaluator(predictor, load_lpips()), out, SCENES_WITH_IMAGES)
    means = mean_of_scenes(results)
    print_means(means, f"{scenes} held-out synthetic scenes, {views} of {pool} views, {_by(shape)}")
    _write(out, {"command": "procedural", "views": views, "pool_views": pool, "size": shape}, predictor, means, results)


@app.command()
@exit_on_input_error
@guards_outputs("idesplat-eval")
def captures(
    out: Out,
    checkouts: Annotated[
        Path | None,
        typer.Option(help="Folder of checkouts, each OWNER+NAME or OWNER/NAME; missing ones are cloned into it."),
    ] = None,
    capture: Annotated[list[str] | None, typer.Option(help="Measure this capture alone; may be repeated.")] = None,
    views: Annotated[str, typer.Option(help="Numbers of context views, with commas; 2 are the triples.")] = "2,3,4,6",
    model: Model = None,
    size: Size = None,
    overwrite: Overwrite = False,
) -> None:
    """Evaluate on real captures at pinned commits of public repositories, cloned where they are not given (git)."""
    from .capture_report import print_captures, write_capture_results
    from .capture_scores import CaptureEvaluator
    from .captures import CaptureImages, parse_view_counts, read_captures
    from .checkouts import clones_folder, extract, fetch_checkout
    from .metrics import load_lpips

    chosen, counts = read_captures(capture or []), parse_view_counts(views)
    predictor = _runner(model, out, [])
    shape = parse_size(size) if size else (predictor.metadata.height, predictor.metadata.width)
    for count in counts:
        predictor.model.check_size(count, *shape)
    folder = checkouts or clones_folder()
    evaluator, results = CaptureEvaluator(predictor, load_lpips()), []
    for entry in progress(chosen, "evaluating"):
        with scratch_folder() as images:
            checkout = fetch_checkout(folder, entry.repository, entry.commit)
            extract(checkout, entry.commit, entry.folder, entry.frames, images)
            loaded = CaptureImages(entry, images, shape)
            results.append(evaluator.evaluate(entry, loaded, counts, partial(_save_strip, out)))
    print_captures(results, counts, _by(shape))
    about = {"command": "captures", "size": shape, "views": counts}
    path = write_capture_results(out, about | _about(predictor), results, counts)
    say(f"wrote {path}")
    say(f"strips (truth, render, error, depth, and for triples the oracle plane) are beside it in {out}")


def main() -> None:
    """Entry point of idesplat-eval."""
    run(app)


def _names(frames: "list[tuple[Path, Camera]]", numbers: list[int]) -> str:
    return ", ".join(frames[number][0].name for number in numbers)


def _by(shape: tuple[int, int]) -> str:
    return f"{shape[0]}x{shape[1]}"


def _runner(model: Path | None, out: Path, data: Sequence[Path]) -> "Predictor":
    """The model, once it is known that results can be written, and will replace nothing of the data or the user.

    Images are named after scenes, which may not be known yet, so any that is there counts as one to be replaced.
    """
    from ...runtime.inference.predictor import Predictor
    from .report import RESULTS

    path = model or bundled_model()
    run = outputs()
    run.reads("the model", model_files(path))
    run.reads("data", data)
    run.writes_into("--out", out)
    run.writes("--out", [out / RESULTS, *out.glob("*.png")])
    return Predictor(path)


def _evaluate(
    cases: "Iterable[EvalCase]",
    total: int,
    evaluator: "Evaluator",
    out: Path,
    with_images: int,
    skip: Skip | None = None,
) -> "list[Result]":
    """Evaluate cases, with a bar on stderr where that is a terminal, and write images of the first `with_images` ones.

    skip: hears of a case that the model cannot take, and why; without it that is an error.
    """
    from ...runtime.images.png import save_png

    results: list[Result] = []
    for case in progress(cases, "evaluating", total):
        strips: dict[str, np.ndarray] = {}
        try:
            results.append(evaluator.evaluate(case, strips.__setitem__ if len(results) < with_images else None))
        except InputError as error:
            if skip is None:
                raise
            skip(case.name, str(error))
        for name, strip in zip(name_files(list(strips)), strips.values(), strict=True):
            save_png(out / f"{case.name}-{name}.png", strip)
    return results


def _save_strip(out: Path, name: str, strip: "np.ndarray") -> None:
    from ...runtime.images.png import save_png

    save_png(out / f"{name}.png", strip)


def _about(predictor: "Predictor") -> dict[str, Any]:
    return {"model": {"path": str(predictor.model.path), **asdict(predictor.metadata)}}


def _write(
    out: Path,
    about: dict[str, Any],
    predictor: "Predictor",
    means: dict[str, dict[str, float]],
    results: "list[Result]",
) -> None:
    """Write results.json and say what there is to look at."""
    from .report import write_results

    path = write_results(out, about | _about(predictor), means, results)
    say(f"wrote {path}")
    say(f"images (truth, render, error, depth, and the oracle plane where there is one) are beside it in {out}")
