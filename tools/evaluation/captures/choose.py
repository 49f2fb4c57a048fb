"""Choose the frames of the validation captures and write `captures.json`.

    python -P -m idesplat.tools.evaluation.captures.choose --checkouts DIR --work DIR

For each capture: cameras from the repository, or estimated from the images; SIFT matches between neighbouring frames
give the scene's depth and the epipolar distance, and frames whose cameras do not fit are left out. A triple is two
frames whose baseline is about a quarter of the depth and a third one between them, which matches both; triples in a row
make a path of views. No model is run.

The file is frozen (docs/captures.md says why), so this is the record of how it was made; a test refuses other frames.
"""

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ....runtime.cameras.camera import Camera
from ....runtime.cameras.io import read_cameras, write_cameras
from ....runtime.cli.terminal import run, say
from ....runtime.errors import InputError
from ....runtime.geometry.quaternions import matrices_to_quaternions
from ....runtime.images.finding import SUFFIXES
from ....runtime.images.png import save_png
from ....runtime.sfm.estimate import estimate_cameras
from ....runtime.system.files import atomic_write, make_folder
from ....runtime.views.batch import match_images_to_cameras
from .capture import CAPTURES_FILE, FORMAT, MAX_VIEWS, VERSION, CaptureSource, load_cropped
from .checkouts import extract, fetch_checkout, list_folder
from .paths import TRIPLES, best_path, path_triples, spread_triples, triple_costs
from .recipes import ESTIMATED, RECIPES, Recipe
from .survey import EpipolarErrors, Survey, cached_survey

# Least overlap of what two of three frames see, and largest baseline. Triples have the first limits that give enough of
# them; the path has looser ones only where these give more views.
OVERLAP_AND_BASELINE = ((0.6, 0.4), (0.5, 0.5), (0.35, 0.8))
# Median over a frame's matches with its best neighbour, and over those of a held-out frame with the views beside it.
MAX_EPIPOLAR_PX = 1.0
DECIMALS = 9


def choose_captures(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    work: Annotated[Path, typer.Option(help="Folder for images and estimated cameras, which are reused.")],
    capture: Annotated[list[str] | None, typer.Option(help="Choose for this capture alone; may be repeated.")] = None,
    keep_frames: Annotated[bool, typer.Option(help="Make the cameras anew, of the frames in the file.")] = False,
) -> None:
    """Choose frames and write the package's captures.json; captures that are not named stay as they are."""
    before = json.loads(CAPTURES_FILE.read_text())["captures"] if CAPTURES_FILE.exists() else []
    entries = {entry["name"]: entry for entry in before}
    order = [recipe.name for recipe in RECIPES]
    for name in capture or ():
        if name not in order:
            raise InputError(f"--capture {name}: no such capture; expected one of {', '.join(order)}")
    recipes = [recipe for recipe in RECIPES if not capture or recipe.name in capture]
    for recipe in recipes if keep_frames else ():
        if recipe.name not in entries:
            raise InputError(f"--keep-frames: {CAPTURES_FILE} has no frames of {recipe.name}; choose them first")
    for recipe in recipes:
        chosen = entries[recipe.name] if keep_frames else None
        entries[recipe.name] = _choose(recipe, checkouts, work, chosen)
        with atomic_write(CAPTURES_FILE) as temporary:
            temporary.write_text(as_json([entries[name] for name in order if name in entries]))
    say(f"wrote {CAPTURES_FILE}: {len(entries)} captures")


def _choose(recipe: Recipe, checkouts: Path, work: Path, chosen: dict[str, Any] | None = None) -> dict[str, Any]:
    """The entry of `captures.json` for a recipe; raises InputError if its frames give too few triples.

    chosen: an entry whose frames are kept.
    """
    images, cameras = _frames(recipe, checkouts, make_folder(work / recipe.name))
    pairs = match_images_to_cameras(images, cameras)
    pairs = [(path, replace(camera, name=path.name)) for path, camera in pairs]
    survey = cached_survey(work / recipe.name / "survey.npz", pairs)
    good = np.flatnonzero(survey.error < MAX_EPIPOLAR_PX)
    extrinsics = np.stack([camera.extrinsics for _, camera in pairs])
    names = [path.name for path, _ in pairs]
    if chosen is None:
        triples, views, between = _select(extrinsics, survey, good, EpipolarErrors(pairs))
    else:
        triples, views, between = kept_frames(chosen, names)
    if len(triples) < TRIPLES:
        raise InputError(f"{recipe.name}: {len(triples)} triples found, expected {TRIPLES}; leave the capture out")
    used = sorted({*np.ravel(triples).tolist(), *views, *between})
    baselines = [float(survey.baseline[a, b]) for a, b, _ in triples]
    say(
        f"{recipe.name}: {len(good)} of {len(pairs)} frames fit, epipolar {np.median(survey.error[used]):.2f} px, "
        f"baseline/depth {np.median(baselines):.2f}, path of {len(views)} views, "
        f"{np.median([survey.baseline[a, b] for a, b in pairwise(views)] or [0]):.2f} apart"
    )
    return {
        **{field.name: getattr(recipe, field.name) for field in fields(CaptureSource)},
        "cameras": recipe.cameras,
        "crop": recipe.crop,
        "epipolar_px": round(float(np.median(survey.error[used])), 2),
        **camera_entries([pairs[index][1] for index in used]),
        "triples": [[names[index] for index in triple] for triple in triples],
        "views": [names[index] for index in views],
        "between": [names[index] for index in between],
    }


def kept_frames(
    chosen: dict[str, Any], names: Sequence[str]
) -> tuple[list[tuple[int, int, int]], list[int], list[int]]:
    """The triples, views and frames between them of an entry, as indices into the names of the frames with a camera.

    Raises InputError for a frame that has none.
    """
    lost = {*np.ravel(chosen["triples"]).tolist(), *chosen["views"], *chosen["between"]} - set(names)
    if lost:
        raise InputError(f"{chosen['name']}: frame {min(lost)} got no camera; choose without --keep-frames")
    triples = [(names.index(a), names.index(b), names.index(target)) for a, b, target in chosen["triples"]]
    views, between = ([names.index(name) for name in chosen[field]] for field in ("views", "between"))
    return triples, views, between


def _select(
    extrinsics: np.ndarray, survey: Survey, good: np.ndarray, errors: EpipolarErrors
) -> tuple[list[tuple[int, int, int]], list[int], list[int]]:
    """Triples, and the views of a path with the frames between them; fewer where the frames do not give enough."""
    positions = extrinsics[:, :3, 3]
    triples: list[tuple[int, int, int]] = []
    path: tuple[list[int], list[int]] = [], []
    for limits in OVERLAP_AND_BASELINE:
        cost = triple_costs(extrinsics, survey, good, *limits)
        if len(triples) < TRIPLES:
            triples = spread_triples(cost, positions, survey)
            while _forbid_mismatches(cost, triples, errors):
                triples = spread_triples(cost, positions, survey)
        if len(path[0]) < MAX_VIEWS:
            longer = best_path(cost, positions)
            while _forbid_mismatches(cost, path_triples(*longer), errors):
                longer = best_path(cost, positions)
            path = max(path, longer, key=lambda path: len(path[0]))
    return triples, *path


def _forbid_mismatches(cost: np.ndarray, triples: Sequence[tuple[int, int, int]], errors: EpipolarErrors) -> bool:
    """Make the cost of triples infinite in which a view does not match the held-out frame; whether there are any."""
    links = [(view, target) for a, b, target in triples for view in (a, b)]
    bad = [(view, target) for view, target in links if errors(view, target) >= MAX_EPIPOLAR_PX]
    for view, target in bad:
        cost[view, :, target] = cost[:, view, target] = np.inf
    return bool(bad)


def _frames(recipe: Recipe, checkouts: Path, work: Path) -> tuple[list[Path], list[Camera]]:
    """The recipe's images, written into the work folder, and their cameras."""
    checkout = fetch_checkout(checkouts, recipe.repository, recipe.commit)
    found = [
        name for name in list_folder(checkout, recipe.commit, recipe.folder) if Path(name).suffix.lower() in SUFFIXES
    ]
    names = sorted(found, key=lambda name: (len(name), name))[recipe.first : recipe.last : recipe.step]
    names = [name for name in names if name not in recipe.excluded]
    missing = [name for name in names if not (work / name).exists()]
    extract(checkout, recipe.commit, recipe.folder, missing, work)
    if recipe.crop is not None:
        for name in missing:
            save_png(work / name, load_cropped(work / name, recipe.crop) / np.float32(255))
    images = [work / name for name in names]
    if recipe.cameras != ESTIMATED:
        parent, _, name = recipe.cameras.rpartition("/")
        source = make_folder(work / "cameras") / name
        if not source.exists():
            inside = list_folder(checkout, recipe.commit, recipe.cameras)
            if inside:
                extract(checkout, recipe.commit, recipe.cameras, inside, source)
            else:
                extract(checkout, recipe.commit, parent, [name], source.parent)
        known = read_cameras(source, images)
    else:
        estimated = work / "estimated.json"
        if not estimated.exists():
            found_cameras = estimate_cameras(images, recipe.focal)
            write_cameras(estimated, [replace(camera, name=Path(camera.name).name) for camera in found_cameras])
        known = read_cameras(estimated)
    stems = {Path(camera.name).stem for camera in known}
    return [image for image in images if image.stem in stems], known


def camera_entries(cameras: Sequence[Camera]) -> dict[str, Any]:
    """The fields `lenses` and `frames` of a capture."""
    lenses: list[dict[str, Any]] = []
    frames = []
    for camera in cameras:
        K = [round(float(value), 4) for value in (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])]
        distortion = None if camera.distortion is None else [round(value, DECIMALS) for value in camera.distortion]
        lens = {"width": camera.width, "height": camera.height, "K": K, "distortion": distortion}
        if lens not in lenses:
            lenses.append(lens)
        quaternion = matrices_to_quaternions(camera.extrinsics[None, :3, :3])[0]
        numbers = [[round(float(value), DECIMALS) for value in part] for part in (quaternion, camera.extrinsics[:3, 3])]
        depth_range = camera.depth_range and [float(f"{depth:.6g}") for depth in camera.depth_range]
        frames.append([Path(camera.name).name, lenses.index(lens), *numbers, depth_range])
    return {"lenses": lenses, "frames": frames}


def as_json(captures: Sequence[dict[str, Any]]) -> str:
    """JSON with a line for each frame."""
    texts = []
    for capture in captures:
        fields = []
        for name, value in capture.items():
            if name in ("frames", "lenses", "triples"):
                rows = ",\n    ".join(json.dumps(row) for row in value)
                fields.append(f'"{name}": [\n    {rows}]')
            else:
                fields.append(f'"{name}": {json.dumps(value)}')
        texts.append("{" + ",\n   ".join(fields) + "}")
    inside = ",\n  ".join(texts)
    return f'{{"format": "{FORMAT}", "version": {VERSION}, "captures": [\n  {inside}]}}\n'


def main() -> None:
    """Run the command."""
    run(choose_captures)


if __name__ == "__main__":
    main()
