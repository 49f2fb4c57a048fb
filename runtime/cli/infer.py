"""The command idesplat-infer: photographs and cameras to a splat file, depth maps and views."""

import json
import os
import shlex
import time
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..cameras.formats import ESTIMATE, CameraFormat
from ..errors import InputError, exit_on_input_error
from ..inference.depth_format import DepthFormat
from .outputs import STANDARD_OUTPUT, Overwrite, guards_outputs, name_files, outputs, write_json
from .terminal import run, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..cameras.camera import Camera
    from ..inference.inputs import Inputs, Request
    from ..inference.predictor import Prediction, Predictor
    from ..splats.filtering import FilterOptions
    from ..views.batch import ViewBatch
    from ..views.depth_range import DepthRange

# Frames of the path that --render draws from the first view to the last.
PATH_FRAMES = 24
# How many pixels COLMAP's fusion asks of a point unless told otherwise.
COLMAP_MIN_PIXELS = 5
# What the folder's name ends in where a model that predicts depth alone is not told where to.
DEPTH_FOLDER = "-depth"
# Beside the scene, the cameras that were estimated for it.
ESTIMATED_CAMERAS = ".cameras.json"
OUT_HELP = (
    "Splats: .ply, .compressed.ply, .splat, .spz, .sog, .glb. Points: .points.ply, .points.glb, .xyz, .obj. "
    "Surfaces: .mesh.ply, .mesh.glb, .mesh.obj."
)
CLEANING = "Cleaning (off unless asked for)"


@exit_on_input_error
@guards_outputs("idesplat-infer")
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
        str | None, typer.Option(help="Photographs to use: names, numbers from 0, 0-3 or 0:8:2, with commas between.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="HEIGHTxWIDTH to work at instead of the trained size.")] = None,
    near: Annotated[float | None, typer.Option(help="Nearest depth in scene units, else found.")] = None,
    far: Annotated[float | None, typer.Option(help="Farthest depth in scene units, else found.")] = None,
    offset: Annotated[
        str | None,
        typer.Option(
            help="Write coordinates relative to this, where they are large (surveys): `auto` finds it if it is needed.",
            metavar="auto|X,Y,Z",
        ),
    ] = None,
    provider: Annotated[str, typer.Option(help="ONNX Runtime execution provider, such as CPU or CUDA.")] = "CPU",
    save_depth: Annotated[Path | None, typer.Option(help="Folder for depth maps with their cameras.")] = None,
    depth_format: Annotated[
        DepthFormat | None,
        typer.Option(help="Of --save-depth: .png and metric .npz (default), or a dense workspace of COLMAP."),
    ] = None,
    render: Annotated[Path | None, typer.Option(help="Folder for views drawn from the result.")] = None,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians.", rich_help_panel=CLEANING)] = 0,
    crop_border: Annotated[
        int, typer.Option(help="Leave out this many pixels along every picture's edges.", rich_help_panel=CLEANING)
    ] = 0,
    max_depth_jump: Annotated[
        float,
        typer.Option(
            help="Leave out pixels whose depth differs from a neighbour's by more than this share, such as 0.05.",
            rich_help_panel=CLEANING,
        ),
    ] = 0,
    min_consistency: Annotated[
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
        Path | None,
        typer.Option(
            help="Write the photographs' cameras: our own JSON, or transforms.json if named so. Estimated ones are "
            "kept in any case, beside the scene."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write one .html that shows views, depth, confidence, timings and settings.")
    ] = None,
    timings: Annotated[bool, typer.Option("--timings", help="Print seconds by stage.")] = False,
    json_path: Annotated[
        Path | None, typer.Option("--json", help="Write a summary as JSON, to standard output if it is -.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Turn posed photographs into a 3D Gaussian splat that every viewer opens."""
    from ..cameras.io import write_cameras
    from ..inference.bundled_model import bundled_model
    from ..inference.inputs import Request, read_inputs
    from ..inference.predictor import Predictor
    from ..splats.filtering import FilterOptions
    from ..splats.io import holds_splats, is_mesh
    from ..system.progress import working

    started = time.perf_counter()
    given = Request([*(images or []), *(more_images or [])], cameras, camera_format, focal, frames, views, size)
    if cameras == ESTIMATE and save_cameras is None:
        save_cameras = _beside(out, ESTIMATED_CAMERAS)
    model = model or bundled_model()
    files = {"--out": out, "--json": json_path, "--save-cameras": save_cameras, "--report": report}
    _announce(given, model, files, {"--save-depth": save_depth, "--render": render})
    _check_range(near, far)
    _check_offset(offset)
    cleaning = FilterOptions(min_opacity, crop_border, max_depth_jump, min_consistency, merge_duplicates)
    with working("loading the model"):
        predictor = Predictor(model, provider)
    _check_fit(predictor, out, cleaning, {"--render": render, "--report": report})
    _check_depth_format(depth_format, save_depth, predictor)
    preparing = time.perf_counter()
    inputs = read_inputs(given, predictor.model)
    prepared = inputs.views
    if not predictor.metadata.gaussians and save_depth is None:  # depth maps are what such a model is for
        save_depth = _beside(out, DEPTH_FOLDER)
    _announce_pictures(given, inputs, save_depth, depth_format, render)
    with working("finding near and far"):
        span = predictor.depth_range(prepared, near, far)
    prepared, place_notes = _place(prepared, offset, span)
    predicting = time.perf_counter()
    prediction = _predict(prepared, predictor, span)
    writing = time.perf_counter()
    cleaned: dict[str, int] = {}
    if cleaning.enabled and not is_mesh(out):
        prediction, cleaned = _clean(prediction, prepared, cleaning)
    _write_scene(prediction, prepared, out, cleaning)
    pictures = _write_pictures(prediction, prepared, save_depth, depth_format, render)
    written = [out]
    if save_cameras is not None:
        found = inputs.cameras
        write_cameras(save_cameras, _named_from(save_cameras.parent, found) if cameras == ESTIMATE else found)
        written.append(save_cameras)
    seconds = {"load": predictor.load_seconds, "prepare": predicting - preparing, **prediction.seconds}
    seconds |= {"write": time.perf_counter() - writing, "total": time.perf_counter() - started}
    summary = _summary(prediction, inputs, cameras, predictor, span, seconds, [*written, *pictures])
    summary |= {"offset": prepared.offset.tolist(), "notes": [*inputs.notes, *place_notes]}
    summary["cleaned"] = {"asked": asdict(cleaning), "left_out": cleaned}
    if report is not None:
        from ..viewer.report import write_report

        write_report(report, prediction.depth, prediction.need_gaussians(), prepared, summary)
        written.append(report)
        summary["files"].append(str(report))
    if json_path is not None:
        write_json(json_path, json.dumps(summary, indent=2))
        if json_path != STANDARD_OUTPUT:
            written.append(json_path)
    for note in [*inputs.notes, *place_notes]:
        say(note)
    say(f"near {span.near:.4g} and far {span.far:.4g}, in the cameras' unit: {span.source}")
    for path in written:
        say(f"wrote {path}{_described(path, prediction, seconds) if path == out else ''}")
    _say_pictures(len(prepared.names), save_depth, depth_format, render)
    if prediction.gaussians is not None and holds_splats(out):
        _say_how_to_look(out, given, save_cameras)
    else:
        say(f"open {out} in MeshLab, CloudCompare or Blender")
    if report is not None:
        say(f"open {report} in any browser")
    if timings:
        _print_timings(seconds)


def main() -> None:
    """Entry point of idesplat-infer."""
    run(infer)


def _say_pictures(views: int, save_depth: Path | None, depth_format: DepthFormat | None, render: Path | None) -> None:
    if save_depth is not None and depth_format is DepthFormat.COLMAP:
        fuse = ["colmap", "stereo_fusion", "--workspace_path", str(save_depth)]
        fuse += ["--output_path", str(save_depth / "fused.ply")]
        if views < COLMAP_MIN_PIXELS:
            fuse += ["--StereoFusion.min_num_pixels", str(views)]
        say(
            f"wrote {save_depth}: {views} depth maps as a dense workspace of COLMAP; to make one cloud of points of it:"
        )
        say("    " + shlex.join(fuse))
    elif save_depth is not None:
        say(f"wrote {save_depth}: {views} depth maps, as .png to look at and as .npz in the cameras' unit")
    if render is not None:
        say(f"wrote {render}: {views} views and {PATH_FRAMES} frames of a path through them, as .png")


def _say_how_to_look(out: Path, given: "Request", save_cameras: Path | None) -> None:
    """Commands to copy, with the cameras that were given, or those that were found and kept."""
    if given.cameras == ESTIMATE:
        cameras = ["--cameras", str(save_cameras)]
    else:
        form = ["--camera-format", given.camera_format] if given.camera_format else []
        cameras = ["--cameras", given.cameras, *form]
    photographs = ["--images", str(given.images[0])] if len(given.images) == 1 else []
    say(f"open {out} in any splat viewer (SuperSplat, for one), look at it in the browser, or draw it:")
    say("    " + shlex.join(["idesplat-view", str(out), *cameras, *photographs]))
    say("    " + shlex.join(["idesplat-render", str(out), *cameras, "--out"]) + " DIR")


def _beside(out: Path, ending: str) -> Path:
    """A path beside the scene, called like it but for the ending."""
    from ..splats.io import splat_suffix

    return out.with_name(out.name[: -len(splat_suffix(out))] + ending)


def _announce(
    given: "Request", model: Path, files: "dict[str, Path | None]", folders: "dict[str, Path | None]"
) -> None:
    """Say, before the work, what is read and what is to be written; raises InputError where that does not go together.

    files, folders: what is to be written, by option.
    """
    from ..splats.io import splat_suffix
    from .input_files import camera_files, given_images, model_files

    run = outputs()
    run.reads("the model", model_files(model))
    run.reads("a photograph", given_images(given.images))
    if given.cameras != ESTIMATE:
        run.reads("the cameras", camera_files(Path(given.cameras)))
    if files["--out"] is not None:
        splat_suffix(files["--out"])
    for option, path in files.items():
        if path is not None and not (option == "--json" and path == STANDARD_OUTPUT):
            run.writes(option, [path])
    for option, folder in folders.items():
        if folder is not None:
            run.writes_into(option, folder)


def _announce_pictures(
    given: "Request", inputs: "Inputs", save_depth: Path | None, depth_format: DepthFormat | None, render: Path | None
) -> None:
    """Say what is written into folders, now that the views are chosen; raises InputError as `_announce`."""
    from ..inference.colmap_workspace import workspace_files
    from ..inference.depth_maps import depth_map_files
    from .input_files import named_images

    run, stems = outputs(), _stems(inputs.views)
    run.reads("a photograph", inputs.photographs)
    if given.cameras != ESTIMATE:
        run.reads("a photograph", named_images(Path(given.cameras), inputs.cameras))
    if save_depth is not None:
        files = workspace_files if depth_format is DepthFormat.COLMAP else depth_map_files
        run.writes("--save-depth", files(save_depth, stems))
    if render is not None:
        run.writes("--render", [render / name for name in (*map(_view_name, stems), *_path_names())])


def _stems(views: "ViewBatch") -> list[str]:
    """What the files that are made of the views are called, but for their endings."""
    return name_files([camera.name for camera in views.cameras])


def _view_name(stem: str) -> str:
    return f"view-{stem}.png"


def _path_names() -> list[str]:
    """The frames of the path through the views."""
    return [f"path-{index:03d}.png" for index in range(PATH_FRAMES)]


def _named_from(folder: Path, cameras: "Sequence[Camera]") -> "list[Camera]":
    """The cameras, their images named as seen from a folder, where they are files; a frame of a video is none."""
    named = []
    for camera in cameras:
        if Path(camera.name).is_file():
            name = os.path.realpath(camera.name)
            with suppress(ValueError):  # on another drive of Windows
                name = os.path.relpath(name, os.path.realpath(folder))
            camera = replace(camera, name=Path(name).as_posix())
        named.append(camera)
    return named


def _described(out: Path, prediction: "Prediction", seconds: dict[str, float]) -> str:
    """What the file of the scene holds, how large it is and how long it took, as the end of a line."""
    from ..splats.io import holds_splats

    splats = prediction.gaussians if holds_splats(out) else None
    count = "" if splats is None else f"{len(splats):,} Gaussians, "
    return f": {count}{out.stat().st_size / 1e6:.1f} MB, in {seconds['total']:.1f} s"


def _check_fit(predictor: "Predictor", out: Path, cleaning: "FilterOptions", drawn: dict[str, Path | None]) -> None:
    """Find out before the work whether the model makes what is asked for.

    Of a model that predicts depth alone, a name that may stand for splats or points stands for points.
    """
    from ..splats.io import MESH_ENDINGS, holds_splats, is_mesh, splat_suffix
    from ..splats.points import POINT_SUFFIXES

    splats = holds_splats(out) and splat_suffix(out) not in POINT_SUFFIXES
    needs = [f"--out {out}"] * splats + [option for option, path in drawn.items() if path is not None]
    if not is_mesh(out):
        needs += [f"--{step.replace('_', '-')}" for step in cleaning.enabled]
    if needs and not predictor.metadata.gaussians:
        endings = ", ".join((*POINT_SUFFIXES, *MESH_ENDINGS))
        raise InputError(
            f"{needs[0]}: {predictor.model.path} predicts depth alone; write points or a surface ({endings})"
        )
    if is_mesh(out) and set(cleaning.enabled) - {"max_depth_jump"}:
        raise InputError(f"--out {out}: of all cleaning a surface knows --max-depth-jump alone; leave out the rest")


def _check_depth_format(depth_format: DepthFormat | None, save_depth: Path | None, predictor: "Predictor") -> None:
    if depth_format is not None and save_depth is None and predictor.metadata.gaussians:
        raise InputError(f"--depth-format {depth_format}: give --save-depth, the folder to write to")


def _check_range(near: float | None, far: float | None) -> None:
    """What can be said of --near and --far before the model's own range is known."""
    for name, value in (("--near", near), ("--far", far)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{name} {value:g}: expected a positive depth in scene units")
    if near is not None and far is not None and near >= far:
        raise InputError(f"--near {near:g} and --far {far:g}: expected near < far")


def _check_offset(offset: str | None) -> None:
    if offset is not None:
        from ..views.world_offset import parse_offset

        parse_offset(offset)


def _place(views: "ViewBatch", offset: str | None, span: "DepthRange") -> "tuple[ViewBatch, list[str]]":
    """The views relative to --offset, and lines for the user."""
    from ..views.world_offset import apply_offset

    return apply_offset(views, offset, span.near)


def _predict(views: "ViewBatch", predictor: "Predictor", span: "DepthRange") -> "Prediction":
    from ..system.progress import working

    with working("predicting depth and Gaussians"):
        return predictor.predict_views(views, span.near, span.far)


def _clean(
    prediction: "Prediction", views: "ViewBatch", cleaning: "FilterOptions"
) -> "tuple[Prediction, dict[str, int]]":
    """The prediction without what is to be left out, and how much that was."""
    from ..splats.filtering import describe_removed, filter_gaussians

    whole = prediction.need_gaussians()
    gaussians, taken = filter_gaussians(whole, prediction.depth, views.extrinsics, views.intrinsics, cleaning)
    say(describe_removed(taken, len(gaussians)))
    return replace(prediction, gaussians=gaussians), taken


def _write_scene(prediction: "Prediction", views: "ViewBatch", out: Path, cleaning: "FilterOptions") -> None:
    """Write the splats, points or surface that the file's name asks for."""
    from ..splats.io import is_mesh, lost_offset, write_splats
    from ..splats.mesh import MAX_DEPTH_JUMP, faces_from_depth
    from ..splats.points import points_from_depth, write_mesh, write_point_cloud

    if not is_mesh(out) and prediction.gaussians is not None:
        for note in write_splats(out, prediction.gaussians, views.offset):
            say(f"note: {note}")
        return
    for note in lost_offset(views.offset):
        say(f"note: {note}")
    points = points_from_depth(prediction.depth, views.images, views.extrinsics, views.intrinsics)
    if is_mesh(out):
        write_mesh(out, points, faces_from_depth(prediction.depth, cleaning.max_depth_jump or MAX_DEPTH_JUMP))
    else:
        write_point_cloud(out, points)


def _write_pictures(
    prediction: "Prediction",
    views: "ViewBatch",
    save_depth: Path | None,
    depth_format: DepthFormat | None,
    render: Path | None,
) -> list[Path]:
    """Write depth maps and drawn views, where asked for; the paths written."""
    stems = _stems(views)
    written = []
    if save_depth is not None:
        written += _write_depth(prediction, views, stems, save_depth, depth_format)
    if render is not None:
        written += _write_renders(prediction, views, stems, render)
    return written


def _write_depth(
    prediction: "Prediction", views: "ViewBatch", stems: list[str], folder: Path, depth_format: DepthFormat | None
) -> list[Path]:
    """Write depth maps in the form that is asked for; the paths written."""
    from ..inference.colmap_workspace import write_workspace
    from ..inference.depth_maps import write_depth_maps

    write = write_workspace if depth_format is DepthFormat.COLMAP else write_depth_maps
    return write(folder, stems, prediction, views)


def _write_renders(prediction: "Prediction", views: "ViewBatch", stems: list[str], folder: Path) -> list[Path]:
    """The scene from the input views, and along a smooth path from the first to the last."""
    import numpy as np

    from ..geometry.trajectories import interpolate_extrinsics
    from ..images.png import save_png
    from ..rendering.render import render_view
    from ..system.progress import progress

    gaussians = prediction.need_gaussians()
    height, width = prediction.depth.shape[1:]
    K = views.intrinsics.astype(np.float64) * np.array([width, height, 1.0])[:, None]  # [views, 3, 3]
    shots = [(_view_name(stem), pose, k) for stem, pose, k in zip(stems, views.extrinsics, K, strict=True)]
    path = interpolate_extrinsics(views.extrinsics, PATH_FRAMES)
    shots += [(name, pose, K.mean(axis=0)) for name, pose in zip(_path_names(), path, strict=True)]
    written = []
    for name, pose, k in progress(shots, "drawing views"):
        save_png(folder / name, render_view(gaussians, pose, k, width, height).rgb)
        written.append(folder / name)
    return written


def _summary(
    prediction: "Prediction",
    inputs: "Inputs",
    cameras: str,
    predictor: "Predictor",
    span: "DepthRange",
    seconds: dict[str, float],
    written: list[Path],
) -> dict[str, Any]:
    import numpy as np

    own, depth = predictor.metadata, prediction.depth
    return {
        "model": {"path": str(predictor.model.path), **asdict(own)},
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
        say(f"{name:>10} {value:8.2f} s")
