"""The command idesplat-infer: photographs and cameras to a splat file, depth maps and views."""

import json
import shlex
import time
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .camera_format import ESTIMATE, CameraFormat
from .errors import InputError, exit_on_input_error
from .files import check_writable, make_folder, replacing

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from .cleaning import Cleaning
    from .depth_range import DepthRange
    from .inputs import Inputs, Request
    from .runner import Prediction, Runner
    from .views import Views

# Frames of the path that --render draws from the first view to the last.
PATH_FRAMES = 24
# What the folder's name ends in where a model that predicts depth alone is not told where to.
DEPTH_FOLDER = "-depth"
OUT_HELP = (
    "Splats: .ply, .compressed.ply, .splat, .spz, .sog, .glb. Points: .points.ply, .points.glb, .xyz, .obj. "
    "Surfaces: .mesh.ply, .mesh.glb, .mesh.obj."
)
CLEANING = "Cleaning (off unless asked for)"


@exit_on_input_error
def infer(
    *,
    images: Annotated[
        list[Path] | None,
        typer.Option(help="Folder, glob or files of photographs, or a video; else the images that the cameras name."),
    ] = None,
    cameras: Annotated[
        str,
        typer.Option(
            help="File or folder of cameras (transforms.json, COLMAP, RealEstate10K, LLFF, DTU, OpenCV stereo, our own "
            "JSON), or `estimate` to find them from the photographs.",
            metavar="PATH|estimate",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help=OUT_HELP, show_default=False)],
    more_images: Annotated[list[Path] | None, typer.Argument(hidden=True)] = None,
    model: Annotated[
        Path | None, typer.Option(help="A .onnx or staged folder of idesplat-export instead of the carried model.")
    ] = None,
    camera_format: Annotated[
        CameraFormat | None, typer.Option(help="Format of the cameras, where their content does not tell it.")
    ] = None,
    focal: Annotated[
        str | None, typer.Option(help="For `estimate`: focal length in pixels, or on 35 mm film such as 26mm.")
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(help="How many photographs to use, the best placed ones: 2, or all --frames.", min=2),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Photographs to use: names or numbers from 0, with commas between.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="HEIGHTxWIDTH to work at instead of the trained size.")] = None,
    near: Annotated[float | None, typer.Option(help="Nearest depth in scene units, else found.")] = None,
    far: Annotated[float | None, typer.Option(help="Farthest depth in scene units, else found.")] = None,
    provider: Annotated[str, typer.Option(help="ONNX Runtime execution provider, such as CPU or CUDA.")] = "CPU",
    save_depth: Annotated[Path | None, typer.Option(help="Folder for depth maps (.png and metric .npz).")] = None,
    render: Annotated[Path | None, typer.Option(help="Folder for views drawn from the result.")] = None,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians.", rich_help_panel=CLEANING)] = 0,
    trim_border: Annotated[
        int, typer.Option(help="Leave out this many pixels along every picture's edges.", rich_help_panel=CLEANING)
    ] = 0,
    trim_edges: Annotated[
        float,
        typer.Option(
            help="Leave out pixels whose depth differs from a neighbour's by more than this share, such as 0.05.",
            rich_help_panel=CLEANING,
        ),
    ] = 0,
    min_confidence: Annotated[
        float,
        typer.Option(
            help="Leave out pixels whose depth a smaller share of the other views confirms, such as 0.5.",
            rich_help_panel=CLEANING,
        ),
    ] = 0,
    merge_duplicates: Annotated[
        bool,
        typer.Option(
            "--merge-duplicates",
            help="Make one Gaussian of those that views put at the same place.",
            rich_help_panel=CLEANING,
        ),
    ] = False,
    save_cameras: Annotated[
        Path | None, typer.Option(help="Write the photographs' cameras: our own JSON, or transforms.json if named so.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write one .html that shows views, depth, confidence, timings and settings.")
    ] = None,
    timings: Annotated[bool, typer.Option("--timings", help="Print seconds by stage.")] = False,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write a summary as JSON.")] = None,
) -> None:
    """Turn posed photographs into a 3D Gaussian splat that every viewer opens."""
    from .cameras import write_cameras
    from .cleaning import Cleaning
    from .default_model import default_model
    from .formats import holds_splats, is_surface
    from .inputs import Request, read_inputs
    from .progress import working
    from .runner import Runner

    started = time.perf_counter()
    _check_outputs(out, (json_path, save_cameras, report), (save_depth, render))
    _check_range(near, far)
    cleaning = Cleaning(min_opacity, trim_border, trim_edges, min_confidence, merge_duplicates)
    given = Request([*(images or []), *(more_images or [])], cameras, camera_format, focal, frames, views, size)
    with working("loading the model"):
        runner = Runner(model or default_model(), provider)
    _check_fit(runner, out, cleaning, {"--render": render, "--report": report})
    preparing = time.perf_counter()
    inputs = read_inputs(given, runner)
    prepared = inputs.views
    with working("finding near and far"):
        span = runner.depth_range(prepared, near, far)
    predicting = time.perf_counter()
    prediction = _predict(prepared, runner, span)
    writing = time.perf_counter()
    cleaned: dict[str, int] = {}
    if cleaning.asked and not is_surface(out):
        prediction, cleaned = _clean(prediction, prepared, cleaning)
    _write_scene(prediction, prepared, out, cleaning)
    if prediction.gaussians is None and save_depth is None:  # depth maps are what such a model is for
        save_depth = make_folder(out.with_name(out.name.partition(".")[0] + DEPTH_FOLDER))
    pictures = _write_pictures(prediction, prepared, save_depth, render)
    written = [out]
    if save_cameras is not None:
        write_cameras(save_cameras, inputs.cameras)
        written.append(save_cameras)
    seconds = {"load": runner.load_seconds, "prepare": predicting - preparing, **prediction.seconds}
    seconds |= {"write": time.perf_counter() - writing, "total": time.perf_counter() - started}
    summary = _summary(prediction, inputs, cameras, runner, span, seconds, [*written, *pictures])
    summary["cleaned"] = {"asked": asdict(cleaning), "left_out": cleaned}
    if report is not None:
        from .inference_report import write_report

        write_report(report, prediction.depth, prediction.need_gaussians(), prepared, summary)
        written.append(report)
        summary["files"].append(str(report))
    if json_path is not None:
        with replacing(json_path) as temporary:
            temporary.write_text(json.dumps(summary, indent=2) + "\n")
        written.append(json_path)
    for note in inputs.notes:
        print(note)
    print(f"near {span.near:.4g} and far {span.far:.4g}, in the cameras' unit: {span.source}")
    for path in written:
        print(f"wrote {path}")
    _say_pictures(len(prepared.names), save_depth, render)
    if prediction.gaussians is not None and holds_splats(out):
        _say_how_to_look(out, given, save_cameras)
    else:
        print(f"open {out} in MeshLab, CloudCompare or Blender")
    if report is not None:
        print(f"open {report} in any browser")
    if timings:
        _print_timings(seconds)


def main() -> None:
    """Entry point of idesplat-infer."""
    typer.run(infer)


def _say_pictures(views: int, save_depth: Path | None, render: Path | None) -> None:
    if save_depth is not None:
        print(f"wrote {save_depth}: {views} depth maps, as .png to look at and as .npz in the cameras' unit")
    if render is not None:
        print(f"wrote {render}: {views} views and {PATH_FRAMES} frames of a path through them, as .png")


def _say_how_to_look(out: Path, given: "Request", save_cameras: Path | None) -> None:
    """Commands to copy. Cameras that were found are of use only where they were kept."""
    cameras: list[str] = []
    if given.cameras != ESTIMATE:
        form = ["--camera-format", given.camera_format] if given.camera_format else []
        cameras = ["--cameras", given.cameras, *form]
    elif save_cameras is not None:
        cameras = ["--cameras", str(save_cameras)]
    photographs = ["--images", str(given.images[0])] if cameras and len(given.images) == 1 else []
    print(f"open {out} in any splat viewer (SuperSplat, for one), look at it in the browser, or draw it:")
    print("    " + shlex.join(["idesplat-view", str(out), *cameras, *photographs]))
    print("    " + shlex.join(["idesplat-render", str(out), *cameras, "--out"]) + " DIR")
    if not cameras:
        print("    (--save-cameras FILE.json keeps the cameras that were found, to be given here as --cameras)")


def _check_outputs(out: Path, files: "Sequence[Path | None]", folders: "Sequence[Path | None]") -> None:
    """Find out before the work whether the results can be written."""
    from .formats import scene_suffix

    scene_suffix(out)
    for path in (out, *files):
        if path is not None:
            if path.is_dir():
                raise InputError(f"{path}: is a folder, expected a file to write")
            check_writable(path.parent)
    for folder in folders:
        if folder is not None:
            check_writable(make_folder(folder))


def _check_fit(runner: "Runner", out: Path, cleaning: "Cleaning", drawn: dict[str, Path | None]) -> None:
    """Find out before the work whether the model makes what is asked for.

    Of a model that predicts depth alone, a name that may stand for splats or points stands for points.
    """
    from .formats import MESHES, holds_splats, is_surface, scene_suffix
    from .point_cloud import POINT_SUFFIXES

    splats = holds_splats(out) and scene_suffix(out) not in POINT_SUFFIXES
    needs = [f"--out {out}"] * splats + [option for option, path in drawn.items() if path is not None]
    if not is_surface(out):
        needs += [f"--{step.replace('_', '-')}" for step in cleaning.asked]
    if needs and not runner.description.gaussians:
        endings = ", ".join((*POINT_SUFFIXES, *MESHES))
        raise InputError(f"{needs[0]}: {runner.path} predicts depth alone; write points or a surface ({endings})")
    if is_surface(out) and set(cleaning.asked) - {"trim_edges"}:
        raise InputError(f"--out {out}: of all cleaning a surface knows --trim-edges alone; leave out the rest")


def _check_range(near: float | None, far: float | None) -> None:
    """What can be said of --near and --far before the model's own range is known."""
    for name, value in (("--near", near), ("--far", far)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{name} {value:g}: expected a positive depth in scene units")
    if near is not None and far is not None and near >= far:
        raise InputError(f"--near {near:g} and --far {far:g}: expected near < far")


def _predict(views: "Views", runner: "Runner", span: "DepthRange") -> "Prediction":
    from .progress import working

    with working("predicting depth and Gaussians"):
        return runner.predict_arrays(views.images, views.extrinsics, views.intrinsics, span.near, span.far)


def _clean(prediction: "Prediction", views: "Views", cleaning: "Cleaning") -> "tuple[Prediction, dict[str, int]]":
    """The prediction without what is to be left out, and how much that was."""
    from .cleaning import clean, describe

    whole = prediction.need_gaussians()
    gaussians, taken = clean(whole, prediction.depth, views.extrinsics, views.intrinsics, cleaning)
    print(describe(taken, len(gaussians)))
    return replace(prediction, gaussians=gaussians), taken


def _write_scene(prediction: "Prediction", views: "Views", out: Path, cleaning: "Cleaning") -> None:
    """Write the splats, points or surface that the file's name asks for."""
    from .depth_mesh import LARGEST_JUMP, faces_from_depth
    from .formats import is_surface, write_scene
    from .point_cloud import points_from_depth, write_mesh, write_point_cloud

    if not is_surface(out) and prediction.gaussians is not None:
        for note in write_scene(out, prediction.gaussians):
            print(f"note: {note}")
        return
    points = points_from_depth(prediction.depth, views.images, views.extrinsics, views.intrinsics)
    if is_surface(out):
        write_mesh(out, points, faces_from_depth(prediction.depth, cleaning.trim_edges or LARGEST_JUMP))
    else:
        write_point_cloud(out, points)


def _write_pictures(
    prediction: "Prediction", views: "Views", save_depth: Path | None, render: Path | None
) -> list[Path]:
    """Write depth maps and drawn views, where asked for; the paths written."""
    stems = _stems(views.names)
    written = []
    if save_depth is not None:
        written += _write_depth(prediction.depth, stems, save_depth)
    if render is not None:
        written += _write_renders(prediction, views, stems, render)
    return written


def _stems(names: list[str]) -> list[str]:
    """File names without suffix, with the view's number in front where two are the same."""
    stems = [PurePath(name).stem for name in names]
    counts = Counter(stems)
    return [stem if counts[stem] == 1 else f"{index}-{stem}" for index, stem in enumerate(stems)]


def _write_depth(depth: "np.ndarray", stems: list[str], folder: Path) -> list[Path]:
    """A colour-mapped PNG and a metric .npz (key `depth`) for each view of depth [views, height, width]."""
    import numpy as np

    from .images_out import save_depth_png

    written = []
    for stem, values in zip(stems, depth, strict=True):
        picture, metric = folder / f"{stem}.png", folder / f"{stem}.npz"
        save_depth_png(picture, values)
        with replacing(metric) as temporary:
            np.savez_compressed(temporary, depth=values)
        written += [picture, metric]
    return written


def _write_renders(prediction: "Prediction", views: "Views", stems: list[str], folder: Path) -> list[Path]:
    """The scene from the input views, and along a smooth path from the first to the last."""
    import numpy as np

    from .drawing import draw_view
    from .images_out import save_png
    from .paths import interpolate_extrinsics
    from .progress import progress

    gaussians = prediction.need_gaussians()
    height, width = prediction.depth.shape[1:]
    K = views.intrinsics.astype(np.float64) * np.array([width, height, 1.0])[:, None]  # [views, 3, 3]
    shots = [(f"view-{stem}.png", pose, k) for stem, pose, k in zip(stems, views.extrinsics, K, strict=True)]
    path = interpolate_extrinsics(views.extrinsics, PATH_FRAMES)
    shots += [(f"path-{index:03d}.png", pose, K.mean(axis=0)) for index, pose in enumerate(path)]
    written = []
    for name, pose, k in progress(shots, "drawing views"):
        save_png(folder / name, draw_view(gaussians, pose, k, width, height).rgb)
        written.append(folder / name)
    return written


def _summary(
    prediction: "Prediction",
    inputs: "Inputs",
    cameras: str,
    runner: "Runner",
    span: "DepthRange",
    seconds: dict[str, float],
    written: list[Path],
) -> dict[str, Any]:
    import numpy as np

    own, depth = runner.description, prediction.depth
    return {
        "model": {"path": str(runner.path), **asdict(own)},
        "cameras": cameras,
        "views": inputs.views.names,
        "notes": inputs.notes,
        "height": depth.shape[1],
        "width": depth.shape[2],
        "near": span.near,
        "far": span.far,
        "near_far_from": span.source,
        "gaussians": 0 if prediction.gaussians is None else len(prediction.gaussians),
        "depth": dict(zip(("smallest", "median", "largest"), np.percentile(depth, (0, 50, 100)).tolist(), strict=True)),
        "seconds": seconds,
        "files": [str(path) for path in written],
    }


def _print_timings(seconds: dict[str, float]) -> None:
    for name, value in seconds.items():
        print(f"{name:>10} {value:8.2f} s")
