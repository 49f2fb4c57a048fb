"""Choose the frames of the validation captures and write `captures.json`.

    python -P -m idesplat.tools.evaluation.choose_captures --checkouts DIR --work DIR

For each capture: cameras from the repository, or estimated from the images; SIFT matches between neighbouring frames
give the scene's depth and the epipolar distance, and frames whose cameras do not fit are left out. A triple is two
frames whose baseline is about a quarter of the depth and a third one between them; triples in a row make a path of
views. No model is run.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ...runtime.cameras.camera import Camera, resize_camera
from ...runtime.cameras.io import read_cameras, write_cameras
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError, exit_on_input_error
from ...runtime.geometry.quaternions import matrices_to_quaternions
from ...runtime.geometry.rigid import invert_rigid
from ...runtime.images.io import SUFFIXES, load_image
from ...runtime.sfm.estimate import estimate_cameras
from ...runtime.sfm.features import match_features, normalize_points, sampson_distance
from ...runtime.system.files import atomic_write, make_folder
from ...runtime.system.progress import progress
from ...runtime.views.batch import match_images_to_cameras
from ...runtime.views.depth_range import scene_depths, triangulated_depths
from ...runtime.views.loader import FeatureImage
from ...runtime.views.selection import score_pairs
from .captures import CAPTURES_FILE, FORMAT, MOST_VIEWS, VERSION
from .checkouts import extract, fetch_checkout, list_folder

ESTIMATED = "estimated"
TRIPLES = 3
BASELINE = 0.25  # of a triple, over the depth of what it sees
SMALLEST_BASELINE = 0.08
# Least overlap of what two of three frames see, and largest baseline: the first that give triples, or a path of views.
LIMITS = ((0.6, 0.4), (0.5, 0.5), (0.35, 0.8))
FEWEST_VIEWS = 6  # of a path, where the last limits leave so many
WORST_EPIPOLAR = 1.0  # pixels, median over a frame's matches with a neighbour
FEWEST_MATCHES = 30
FARTHEST_ASIDE = 0.7  # how far a held-out frame stands from the line between its neighbours, in baselines
EARLIEST, LATEST = 0.2, 0.8  # where it stands along that line
SAME_PLACE = 0.4  # baselines: views of a path stand farther from each other
PARTNERS = 3
STARTS = 60
DECIMALS = 9
TINY = 1e-3


@dataclass(frozen=True)
class Recipe:
    """A capture to choose from. cameras: a path in the repository, or ESTIMATED. step: take one of so many images."""

    name: str
    kind: str
    content: str
    licence: str
    repository: str
    commit: str
    folder: str
    cameras: str
    first: int = 0
    last: int | None = None
    step: int = 1
    focal: str | None = None


RECIPES = (
    Recipe(
        "office",
        "room",
        "office, computer tower on a cabinet",
        "none stated",
        "LakshyaTaneja/Metric-Semantic-3D-Reconstruction",
        "40979ab3bf2ef38496d7148758032b1647c51476",
        "data/images",
        "data/transforms.json",
    ),
    Recipe(
        "lockers",
        "room",
        "university room with lockers and tables",
        "none stated",
        "mamechun/gs_data",
        "57e50c56a1e601e468e012e0814187e5f698825b",
        "dense/0/images",
        "dense/0/sparse",
    ),
    Recipe(
        "fruit",
        "object",
        "apple and banana on quilted cloth",
        "none stated",
        "tusharparimi/fruit-NeRF",
        "236cb0105d687745f7a13f454679346a64ac47d6",
        "newfruit_small",
        "transforms.json",
    ),
    Recipe(
        "cup",
        "object",
        "coffee cup on a wooden desk",
        "none stated",
        "kwrous/final_tensorf",
        "85c25f19aecbf4b170a68e0fa93c19805b28de3b",
        "images",
        "sparse/0",
    ),
    Recipe(
        "figurine",
        "object",
        "stone figurine close up",
        "none stated",
        "bartoszek/test_colmap",
        "79fce7a67f15b0604e9741d9d50618840740b32f",
        "dense/0/images",
        "dense/0/sparse",
    ),
    Recipe(
        "can",
        "object",
        "drink can on tiles, railing",
        "none stated",
        "YhuoyuH/NeRF-Database",
        "83b34224ffb43e34e48db8137b3f95f8e7059cc3",
        "images",
        "sparse/0",
    ),
    Recipe(
        "fountain",
        "facade",
        "fountain-P11: relief before a brick wall",
        "none stated (Strecha et al.)",
        "ShengyuH/PySFM",
        "478dedcf42f7f1c88682be393f8f58a8d0b2a338",
        "matlab-code/data/images_50",
        ESTIMATED,
    ),
    Recipe(
        "rails",
        "outdoors",
        "rails on concrete slabs and tiles",
        "none stated",
        "wufake70/RailsDataSynthesis",
        "d8dd079350ed43f7a3bdfe4f32a9bbb79cecabf5",
        "rails/images",
        "rails/transforms.json",
    ),
    Recipe(
        "plant",
        "vegetation",
        "potted plant on newspapers, living room",
        "none stated",
        "lvllvl/NeRF",
        "3b6aec04f821cc5686fc40174aebfed7d182fcb9",
        "data/raw",
        ESTIMATED,
        last=70,
    ),
    Recipe(
        "city",
        "aerial",
        "city with trees from a drone",
        "none stated",
        "Zeus-Xu/NeRF-3DGS",
        "30655651735acc321cbe9e9eb7560c7c9295a57a",
        "images",
        ESTIMATED,
        step=3,
    ),
)


@dataclass(frozen=True, eq=False)
class Survey:
    """What matching found of frames: depth and epipolar error in pixels [frames], and pairwise overlap and baseline.

    baseline: between each two, over the depth of what they see, [frames, frames].
    """

    depth: np.ndarray
    error: np.ndarray
    overlap: np.ndarray
    baseline: np.ndarray


@exit_on_input_error
def choose_captures(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    work: Annotated[Path, typer.Option(help="Folder for images and estimated cameras, which are reused.")],
    capture: Annotated[list[str] | None, typer.Option(help="Choose for this capture alone; may be repeated.")] = None,
) -> None:
    """Choose frames and write the package's captures.json; captures that are not named stay as they are."""
    before = json.loads(CAPTURES_FILE.read_text())["captures"] if CAPTURES_FILE.exists() else []
    entries = {entry["name"]: entry for entry in before}
    order = [recipe.name for recipe in RECIPES]
    for recipe in RECIPES:
        if not capture or recipe.name in capture:
            entries[recipe.name] = _choose(recipe, checkouts, work)
            with atomic_write(CAPTURES_FILE) as temporary:
                temporary.write_text(as_json([entries[name] for name in order if name in entries]))
    say(f"wrote {CAPTURES_FILE}: {len(entries)} captures")


def _choose(recipe: Recipe, checkouts: Path, work: Path) -> dict[str, Any]:
    images, cameras = _frames(recipe, checkouts, make_folder(work / recipe.name))
    pairs = match_images_to_cameras(images, cameras)
    pairs = [(path, replace(camera, name=path.name)) for path, camera in pairs]
    survey = _kept_survey(work / recipe.name / "survey.npz", pairs)
    good = np.flatnonzero(survey.error < WORST_EPIPOLAR)
    places = np.stack([camera.extrinsics[:3, 3] for _, camera in pairs])
    triples: list[tuple[int, int, int]] = []
    views: list[int] = []
    between: list[int] = []
    for limits in LIMITS:
        cost = _triple_costs(places, survey, good, *limits)
        if len(triples) < TRIPLES:
            triples = _spread(cost, places, survey)
        if len(views) < FEWEST_VIEWS:
            views, between = _longest_path(cost, places, survey)
    if len(triples) < TRIPLES:
        raise InputError(f"{recipe.name}: {len(triples)} triples found, expected {TRIPLES}; leave the capture out")
    names = [path.name for path, _ in pairs]
    used = sorted({*np.ravel(triples).tolist(), *views, *between})
    baselines = [float(survey.baseline[a, b]) for a, b, _ in triples]
    say(
        f"{recipe.name}: {len(good)} of {len(pairs)} frames fit, epipolar {np.median(survey.error[used]):.2f} px, "
        f"baseline/depth {np.median(baselines):.2f}, path of {len(views)} views, "
        f"{np.median([survey.baseline[a, b] for a, b in pairwise(views)] or [0]):.2f} apart"
    )
    return {
        **{field: getattr(recipe, field) for field in ("name", "kind", "content", "licence", "repository", "commit")},
        "folder": recipe.folder,
        "cameras": recipe.cameras,
        "epipolar_px": round(float(np.median(survey.error[used])), 2),
        **camera_entries([pairs[index][1] for index in used]),
        "triples": [[names[index] for index in triple] for triple in triples],
        "views": [names[index] for index in views],
        "between": [names[index] for index in between],
    }


def _frames(recipe: Recipe, checkouts: Path, work: Path) -> tuple[list[Path], list[Camera]]:
    """The recipe's images, written into the work folder, and their cameras."""
    checkout = fetch_checkout(checkouts, recipe.repository, recipe.commit)
    found = [
        name for name in list_folder(checkout, recipe.commit, recipe.folder) if Path(name).suffix.lower() in SUFFIXES
    ]
    names = sorted(found, key=lambda name: (len(name), name))[recipe.first : recipe.last : recipe.step]
    missing = [name for name in names if not (work / name).exists()]
    extract(checkout, recipe.commit, recipe.folder, missing, work)
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


def _kept_survey(path: Path, pairs: Sequence[tuple[Path, Camera]]) -> Survey:
    """What `_survey` finds, kept in a file."""
    if not path.exists():
        with atomic_write(path) as temporary:
            np.savez(temporary, **vars(_survey(pairs)))
    with np.load(path) as content:
        return Survey(**content)


def _survey(pairs: Sequence[tuple[Path, Camera]]) -> Survey:
    """Match each frame with its best neighbours."""
    cameras = [camera for _, camera in pairs]
    samples = [_sample(*pair) for pair in progress(pairs, "finding features")]
    distances, _ = scene_depths(cameras, samples.__getitem__)
    cost = score_pairs(cameras, distances).cost
    error, depth = np.full(len(pairs), np.inf), np.array(distances, float)
    for i in range(len(pairs)):
        partners = [int(j) for j in np.argsort(cost[i])[:PARTNERS] if np.isfinite(cost[i, j])]
        found = [_epipolar(samples[i], samples[j]) for j in partners]
        error[i] = min((value for value, _ in found), default=np.inf)
        depths = np.concatenate([np.zeros(0), *(values for _, values in found)])
        if len(depths) >= FEWEST_MATCHES:
            depth[i] = np.median(depths)
    places = np.stack([camera.extrinsics[:3, 3] for camera in cameras])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return Survey(depth, error, score_pairs(cameras, depth).overlap, apart / np.sqrt(depth[:, None] * depth[None]))


def _sample(path: Path, camera: Camera) -> FeatureImage:
    image = load_image(path)
    return FeatureImage(image, resize_camera(camera, image.shape[1], image.shape[0]))


def _epipolar(first: FeatureImage, second: FeatureImage) -> tuple[float, np.ndarray]:
    """Median epipolar distance of two frames' matches in pixels, and depths in the first frame."""
    a, b, first_camera, second_camera = first.features, second.features, first.camera, second.camera
    matches = match_features(a, b)
    if len(matches) < FEWEST_MATCHES:
        return np.inf, np.zeros(0)
    between = invert_rigid(second_camera.extrinsics) @ first_camera.extrinsics
    rays = (
        normalize_points(a.keypoints[matches[:, 0]], first_camera.K),
        normalize_points(b.keypoints[matches[:, 1]], second_camera.K),
    )
    focal = np.sqrt(first_camera.K[0, 0] * second_camera.K[0, 0])
    error = float(np.median(sampson_distance(*rays, between)) * focal)
    return error, triangulated_depths(a, b, first_camera.K, second_camera.K, between)[0]


def _triple_costs(
    places: np.ndarray, survey: Survey, good: np.ndarray, least_overlap: float, largest_baseline: float
) -> np.ndarray:
    """How far each (first, second, target) is from a good triple, infinite if not allowed, [frames, frames, frames]."""
    count = len(places)
    cost = np.full((count, count, count), np.inf)
    for a in good:
        for b in good[good > a]:
            ratio = survey.baseline[a, b]
            if not SMALLEST_BASELINE <= ratio <= largest_baseline or survey.overlap[a, b] < least_overlap:
                continue
            way = places[b] - places[a]
            along = (places[good] - places[a]) @ way / (way @ way)
            aside = np.linalg.norm(places[good] - places[a] - along[:, None] * way, axis=1) / np.linalg.norm(way)
            overlap = np.minimum(survey.overlap[a, b], np.minimum(survey.overlap[a, good], survey.overlap[b, good]))
            off_middle = 2 * np.abs(along - 0.5) + aside
            found = np.abs(np.log2(ratio / BASELINE)) + off_middle - np.log2(np.maximum(overlap, TINY))
            allowed = (along > EARLIEST) & (along < LATEST) & (aside < FARTHEST_ASIDE) & (overlap >= least_overlap)
            cost[a, b, good] = cost[b, a, good] = np.where(allowed & (good != a) & (good != b), found, np.inf)
    return cost


def _spread(cost: np.ndarray, places: np.ndarray, survey: Survey) -> list[tuple[int, int, int]]:
    """The best triple, then others that are good and far from those chosen."""
    chosen: list[tuple[int, int, int]] = []
    penalty = np.zeros(len(places))
    for _ in range(TRIPLES):
        total = cost + penalty
        index = np.unravel_index(np.argmin(total), cost.shape)
        if not np.isfinite(total[index]):
            return chosen
        a, b, target = (int(i) for i in index)
        chosen.append((min(a, b), max(a, b), target))
        near = np.linalg.norm(places - places[target], axis=1) / survey.depth[target]
        penalty += 2 * np.exp(-np.square(near / BASELINE))
        penalty[target] = np.inf
    return chosen


def _longest_path(cost: np.ndarray, places: np.ndarray, survey: Survey) -> tuple[list[int], list[int]]:
    """The path of most views, with a held-out frame between each two, that starts at one of the better triples.

    No views where there is no triple.
    """
    best = np.unique(cost[np.isfinite(cost)])[:STARTS]
    paths: list[tuple[int, float, list[int], list[int]]] = [(0, 0.0, [], [])]
    for value in best:
        a, b, target = (int(i[0]) for i in np.nonzero(cost == value))
        views, between = [a, b], [target]
        while len(views) < MOST_VIEWS and _extend(views, between, cost, places):
            pass
        steps = [cost[first, second, held] for first, second, held in zip(views, views[1:], between, strict=False)]
        paths.append((-len(views), float(np.mean(steps)), views, between))
    _, _, views, between = min(paths)
    return views, between


def _extend(views: list[int], between: list[int], cost: np.ndarray, places: np.ndarray) -> bool:
    """Add the best next view and held-out frame at either end of the path; False if there is none."""
    best = (np.inf, 0, 0, False)
    for end, previous, at_front in ((views[-1], views[-2], False), (views[0], views[1], True)):
        options = cost[end].copy()  # [view, target]
        options[:, [*views, *between]] = np.inf
        options[between] = np.inf
        step = np.linalg.norm(places[end] - places[previous])
        distance = np.linalg.norm(places[:, None] - places[views], axis=-1).min(axis=1)
        options[distance < SAME_PLACE * step] = np.inf
        onward = (places - places[end]) @ (places[end] - places[previous]) > 0
        options[~onward] = np.inf
        view, target = (int(i) for i in np.unravel_index(options.argmin(), options.shape))
        if options[view, target] < best[0]:
            best = (float(options[view, target]), view, target, at_front)
    value, view, target, at_front = best
    if not np.isfinite(value):
        return False
    views.insert(0 if at_front else len(views), view)
    between.insert(0 if at_front else len(between), target)
    return True


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
