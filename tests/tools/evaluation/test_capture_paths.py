"""Selection of triples and of paths of views: against an exhaustive search, and on a straight line of cameras."""

from itertools import pairwise

import numpy as np
import pytest
from idesplat.tools.evaluation.captures.paths import (
    MIN_SPACING,
    PATH_LENGTHS,
    TRIPLES,
    best_path,
    spread_triples,
    triple_costs,
)
from idesplat.tools.evaluation.captures.survey import Survey


def survey_of(positions: np.ndarray) -> Survey:
    """Cameras that look at a wall at depth 1, of which each sees a width of 1."""
    baseline = np.linalg.norm(positions[:, None] - positions, axis=-1)
    count = len(positions)
    return Survey(np.ones(count), np.zeros(count), np.clip(1 - baseline, 0, 1), baseline)


def costs(positions: np.ndarray, rotations: np.ndarray | None = None) -> np.ndarray:
    extrinsics = np.tile(np.eye(4), (len(positions), 1, 1))
    extrinsics[:, :3, 3] = positions
    if rotations is not None:
        extrinsics[:, :3, :3] = rotations
    return triple_costs(extrinsics, survey_of(positions), np.arange(len(positions)), 0.5, 0.5)


def line(count: int, spacing: float) -> np.ndarray:
    return np.arange(count)[:, None] * np.array([spacing, 0, 0])


def most_views(cost: np.ndarray, positions: np.ndarray, views: list[int], between: list[int]) -> int:
    """The number of views of the longest path that starts with these, by trying everything."""
    most = len(views)
    for view, target in zip(*np.nonzero(np.isfinite(cost[views[-1]])), strict=True):
        step = positions[views[-1]] - positions[views[-2]] if len(views) > 1 else np.zeros(3)
        near = min(np.linalg.norm(positions[view] - positions[earlier]) for earlier in views)
        ahead = len(views) == 1 or (positions[view] - positions[views[-1]]) @ step > 0
        if ahead and near >= MIN_SPACING * np.linalg.norm(step) and not {view, target} & {*views, *between}:
            most = max(most, most_views(cost, positions, [*views, view], [*between, target]))
    return most


@pytest.mark.parametrize("seed", range(6))
def test_no_path_has_more_views(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = line(9, 0.12) + rng.normal(0, 0.05, (9, 3)) * (1, 1, 0.2)
    cost = costs(positions)
    views, _ = best_path(cost, positions)
    most = max(most_views(cost, positions, [start], []) for start in range(len(positions)))
    assert most > 2 and len(views) == max(length for length in PATH_LENGTHS if length <= most)


def test_a_path_advances_and_holds_a_frame_out_between_each_two_views() -> None:
    positions = line(60, 0.06)
    views, between = best_path(costs(positions), positions)
    assert len(views) == 24 and len(between) == 23
    ordered = [frame for step in zip(views, between, strict=False) for frame in step] + [views[-1]]
    assert all(np.diff(ordered) > 0) or all(np.diff(ordered) < 0)


def test_the_best_steps_are_in_the_middle_of_the_path() -> None:
    """Cameras of which a few have the ideal spacing; all paths of 12 views with these have the same total cost."""
    spacing = np.full(40, 0.16)
    spacing[14:20] = 0.125
    positions = np.concatenate([[0], np.cumsum(spacing)])[:, None] * np.array([1.0, 0, 0])
    views, _ = best_path(costs(positions), positions)
    steps = [abs(positions[b, 0] - positions[a, 0]) for a, b in pairwise(views)]
    assert len(views) == 12 and steps[4:7] == pytest.approx([0.25] * 3)


def test_a_frame_rolled_far_from_the_others_is_in_no_triple() -> None:
    degrees = np.array([0, 20, 40, 70, 40, 20])
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotations = np.tile(np.eye(3), (6, 1, 1))
    rotations[:, 0, 0], rotations[:, 0, 1], rotations[:, 1, 0], rotations[:, 1, 1] = cosine, -sine, sine, cosine
    allowed = np.isfinite(costs(line(6, 0.1), rotations))
    assert not allowed[0, :, 3].any() and not allowed[0, 3].any() and allowed[0, 4].any()
    assert allowed[1, 5, 3] and allowed[1, 3, 2]  # 50 degrees


def test_without_triples_there_is_no_path() -> None:
    positions = line(5, 2.0)
    assert best_path(costs(positions), positions) == ([], [])
    assert spread_triples(costs(positions), positions, survey_of(positions)) == []


def test_triples_have_the_baseline_asked_for_and_lie_apart() -> None:
    positions = line(40, 0.05)
    triples = spread_triples(costs(positions), positions, survey_of(positions))
    assert len(triples) == TRIPLES
    assert [positions[b, 0] - positions[a, 0] for a, b, _ in triples] == pytest.approx([0.25] * TRIPLES, abs=0.051)
    assert all(a < target < b for a, b, target in triples)
    targets = sorted(target for _, _, target in triples)
    assert min(np.diff(targets)) * 0.05 > 0.25
