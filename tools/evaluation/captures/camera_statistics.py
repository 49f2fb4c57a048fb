"""How the cameras of the validation captures differ within a pair of views, and how those of training scenes do.

    python -P -m idesplat.tools.evaluation.captures.camera_statistics --checkouts DIR

The pairs are the context views of the captures' triples, and the two context views of synthetic training samples; with
`--views` above 2, neighbouring context views. The depth d of a pair is a median over both views: of points that are
matched between them and triangulated for captures, of all pixels' exact depth for synthetic scenes.
"""

import json
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from ....runtime.cli.terminal import run, say
from ....runtime.geometry.depth_bounds import MIN_POINTS
from ....runtime.geometry.rigid import invert_rigid
from ....runtime.system.files import atomic_write
from ....runtime.system.progress import progress
from ....runtime.views.depth_range import triangulated_depths
from ....runtime.views.loader import LoadedView, load_view
from ...synthetic.sampler import TRAINING_SEEDS, Sample, generate_sample
from ..report import print_table
from .capture import MAX_VIEWS, PAIR, Capture, load_cropped, read_captures
from .checkouts import frames_of

INPUT_SIZE = 256, 256  # pixels, of the network's images, to which captures are cropped
SYNTHETIC_SIZE = 64, 64  # pixels; enough for a median depth
SYNTHETIC_TARGETS = 2
QUANTILES = (0.1, 0.5, 0.9)
CAPTURES, TRAINING = "captures", "training"

BASELINE = "baseline / depth"
AXES = "angle between the optical axes, degrees"
MIDDLE = "angle at the scene's middle, degrees"
CONVERGENCE = "convergence"
ROLL = "roll, degrees"
SHARES = ("baseline along x", "baseline along y", "baseline along z")
FIELD_OF_VIEW = "field of view, degrees"
WHOLE_FIELD_OF_VIEW = "field of view before the crop, degrees"

Statistics = dict[str, float]
Quantiles = dict[str, list[float]]


def print_statistics(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    capture: Annotated[list[str] | None, typer.Option(help="Use this capture alone; may be repeated.")] = None,
    samples: Annotated[int, typer.Option(help="Training samples that are measured.", min=1)] = 400,
    views: Annotated[int, typer.Option(help="Context views of a sample or window.", min=PAIR, max=MAX_VIEWS)] = PAIR,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the quantiles to this file, too.")] = None,
) -> None:
    """Print how the cameras of two views differ in the validation captures, and in synthetic training scenes."""
    found = [pair for source in read_captures(capture or ()) for pair in capture_statistics(source, checkouts, views)]
    seeds = progress(TRAINING_SEEDS[:samples], "generating samples")
    generated = [pair for seed in seeds for pair in sample_statistics(_sample(seed, views))]
    quantiles = {CAPTURES: quantiles_of(found), TRAINING: quantiles_of(generated)}
    say(f"{len(found)} pairs of views of captures, {len(generated)} of synthetic training scenes")
    _print(quantiles)
    if json_path is not None:
        content = {"views": views, "pairs": {CAPTURES: len(found), TRAINING: len(generated)}, "quantiles": quantiles}
        with atomic_write(json_path) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n")


def pair_statistics(extrinsics: np.ndarray, depth: float) -> Statistics:
    """How two cameras differ; extrinsics: camera-to-world, OpenCV axes, [2, 4, 4]; depth: d, in the same unit.

    With the positions c1, c2, the optical axes z1, z2 (unit vectors), and the rotation R of the second camera in the
    first camera's frame:

    - baseline / depth: |c2 - c1| / d.
    - angle between the optical axes: acos(z1 . z2).
    - angle at the scene's middle: between the rays from m to c1 and to c2. m is half way between the points at depth d
      on the two axes. It is the triangulation angle, and that of the orbit where both cameras look at one point at d.
    - convergence: d (z1 - z2) . (c2 - c1) / |c2 - c1|^2. It is 1 where the axes meet at d (an orbit), 0 where they are
      parallel (sideways motion), and negative where they diverge.
    - roll: |atan2(R10 - R01, R00 + R11)|, the twist of R about the optical axis.
    - baseline along x, y, z: squares of the components of the baseline's direction, the mean of those in the two
      cameras' frames. They sum to 1.
    """
    positions, axes = extrinsics[:, :3, 3], extrinsics[:, :3, 2]
    baseline = positions[1] - positions[0]
    length = float(np.linalg.norm(baseline))
    middle = (positions + depth * axes).mean(axis=0)
    turn = extrinsics[0, :3, :3].T @ extrinsics[1, :3, :3]
    shares = np.square(baseline / length @ extrinsics[:, :3, :3]).mean(axis=0)
    return {
        BASELINE: length / depth,
        AXES: _angle(axes[0], axes[1]),
        MIDDLE: _angle(positions[0] - middle, positions[1] - middle),
        CONVERGENCE: float(depth * (axes[0] - axes[1]) @ baseline / length**2),
        ROLL: abs(float(np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))),
        **dict(zip(SHARES, shares.tolist(), strict=True)),
    }


def field_of_view(K: np.ndarray, width: float, height: float) -> float:
    """The angle in degrees that the longer side subtends at the camera: 2 atan(side / (2 f)); K: in pixels, [3, 3]."""
    side, focal = (width, K[0, 0]) if width >= height else (height, K[1, 1])
    return float(np.degrees(2 * np.arctan(side / (2 * focal))))


def quantiles_of(pairs: Sequence[Statistics]) -> Quantiles:
    """The QUANTILES of each quantity over pairs."""
    return {name: np.quantile([pair[name] for pair in pairs], QUANTILES).tolist() for name in pairs[0]}


def capture_statistics(source: Capture, checkouts: Path, views: int = PAIR) -> Iterator[Statistics]:
    """The statistics of a capture's pairs: those of its triples, or neighbours in the middle of its path of views.

    Pairs with too few matches for a median depth are left out, with a message. Raises InputError as `frames_of`.
    """
    with frames_of(checkouts, source) as folder:
        for names in _pairs(source, views):
            loaded = [_load(source, folder, name) for name in names]
            depth = _matched_depth(*loaded)
            if depth is None:
                say(f"{source.name}, {' and '.join(names)}: fewer than {MIN_POINTS} matches, left out")
                continue
            camera = loaded[0].camera
            yield {
                **pair_statistics(np.stack([view.camera.extrinsics for view in loaded]), depth),
                FIELD_OF_VIEW: field_of_view(loaded[0].intrinsics, 1, 1),
                WHOLE_FIELD_OF_VIEW: field_of_view(camera.K, camera.width, camera.height),
            }


def sample_statistics(sample: Sample) -> Iterator[Statistics]:
    """The statistics of a synthetic sample's neighbouring context views."""
    height, width = sample.depth.shape[1:]
    for first, second in pairwise(range(sample.context)):
        both = [first, second]
        field = field_of_view(sample.intrinsics[first] * [[width], [height], [1]], width, height)
        yield {
            **pair_statistics(sample.extrinsics[both].astype(np.float64), float(np.median(sample.depth[both]))),
            FIELD_OF_VIEW: field,
            WHOLE_FIELD_OF_VIEW: field,
        }


def _pairs(source: Capture, views: int) -> Sequence[tuple[str, str]]:
    if views == PAIR:
        return [triple.context for triple in source.triples]
    return list(pairwise(source.window(views)[0]))


def _load(source: Capture, folder: Path, name: str) -> LoadedView:
    return load_view((load_cropped(folder / name, source.crop), source.cameras[name]), *INPUT_SIZE, with_features=True)


def _matched_depth(first: LoadedView, second: LoadedView) -> float | None:
    """The median depth in both views of the points that are matched between them; None where few are."""
    one, other = first.feature_image, second.feature_image
    assert one is not None and other is not None, "views are loaded with features"
    between = invert_rigid(second.camera.extrinsics) @ first.camera.extrinsics
    depths = triangulated_depths(one.features, other.features, one.camera.K, other.camera.K, between)
    return float(np.median(depths)) if len(depths[0]) >= MIN_POINTS else None


def _sample(seed: int, views: int) -> Sample:
    """The training sample of a seed, whose images are black: no rays are cast for them."""
    return generate_sample(seed, views, SYNTHETIC_TARGETS, *SYNTHETIC_SIZE, samples=0)


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """The angle between two vectors in degrees, accurate where it is small."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


def _print(quantiles: dict[str, Quantiles]) -> None:
    table = Table()
    table.add_column("quantity")
    for kind in quantiles:
        for quantile in QUANTILES:
            table.add_column(f"{kind}\n{quantile:.0%}", justify="right")
    for name in quantiles[CAPTURES]:
        cells = [f"{value:.3g}" for kind in quantiles.values() for value in kind[name]]
        table.add_row(name, *cells)
    print_table(table)


def main() -> None:
    """Run the command."""
    run(print_statistics)


if __name__ == "__main__":
    main()
