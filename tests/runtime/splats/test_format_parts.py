"""What the formats are made of: half turns, quaternions in three parts, orders, codebooks."""

from pathlib import Path

import numpy as np
import pytest
from idesplat.runtime.geometry.quaternions import from_smallest_three, normalize_quaternions, smallest_three
from idesplat.runtime.rendering.rasterizer import rasterize
from idesplat.runtime.splats.axes import GLTF, OPENGL, convert_axes
from idesplat.runtime.splats.formats import codebooks
from idesplat.runtime.splats.formats.codebooks import build_codebook, cluster_vectors, quantize
from idesplat.runtime.splats.formats.compressed_ply import CHUNK
from idesplat.runtime.splats.formats.encoding import clipped_note
from idesplat.runtime.splats.formats.morton import morton_order
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_splats, write_splats
from splat_cases import ARRAYS, load_truth


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return load_truth()


@pytest.mark.parametrize("signs", [OPENGL, GLTF])
def test_a_half_turn_is_a_rotation_of_the_whole_scene(truth: Gaussians, signs: tuple[int, int, int]) -> None:
    """The rotated scene, rendered by the rotated camera, gives the same image."""
    turn = np.diag([*signs, 1.0])
    assert np.linalg.det(turn) == 1
    turned = convert_axes(truth, signs)
    K = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    rendered = [
        rasterize(s.means, s.quats, s.scales, s.opacities, s.sh, viewmat, K, 80, 60).rgb
        for s, viewmat in ((truth, np.eye(4)), (turned, turn))
    ]
    assert rendered[0].max() > 0.5
    np.testing.assert_allclose(rendered[1], rendered[0], atol=2e-5)
    again = convert_axes(turned, signs)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(truth, name))


def test_smallest_three_and_back() -> None:
    quats = normalize_quaternions(np.random.default_rng(0).normal(size=(500, 4)) * 1e-9)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, rtol=1e-6)
    largest, others = smallest_three(quats)
    assert np.abs(others).max() <= np.sqrt(0.5) + 1e-6
    back = from_smallest_three(largest, others)
    sign = np.sign(np.take_along_axis(quats, largest[:, None], axis=1))
    np.testing.assert_allclose(back, quats * sign, atol=1e-6)
    extremes = np.float32([[0, 0, 0, 0], [1e30, 0, 0, 0], [3e38, -3e38, 0, 0]])
    np.testing.assert_allclose(
        normalize_quaternions(extremes), [[1, 0, 0, 0], [1, 0, 0, 0], [0.5**0.5, -(0.5**0.5), 0, 0]]
    )


def test_morton_order_keeps_neighbours_together() -> None:
    points = np.random.default_rng(0).permutation(np.stack(np.meshgrid(*[np.arange(16)] * 3), axis=-1).reshape(-1, 3))
    order = morton_order(points)
    assert sorted(order) == list(range(len(points)))
    cubes = points[order].reshape(-1, 64, 3)  # 4 x 4 x 4 neighbours each
    assert (np.ptp(cubes, axis=1) == 3).all()
    assert morton_order(np.zeros((3, 3))).tolist() == [0, 1, 2]


def test_chunks_keep_their_own_precision(tmp_path: Path) -> None:
    """Two clusters far apart: each is as fine as its own extent allows, not the scene's."""
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 0.01, (2 * CHUNK, 3)).astype(np.float32)
    means[CHUNK:] += 1000
    count = len(means)
    scene = Gaussians(
        means,
        np.full((count, 3), 0.01, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 0.5, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    write_splats(tmp_path / "scene.compressed.ply", scene)
    near = read_splats(tmp_path / "scene.compressed.ply").means
    near = near[near[:, 0] < 500]
    distance = np.abs(near[:, None] - means[None, :CHUNK]).max(axis=-1).min(axis=1)
    assert distance.max() <= 0.01 / 2046 + 1e-6


def test_codebooks_reach_everywhere_and_are_dense_where_values_are() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(0, 0.01, 20_000), [-5, 5]])
    codebook = build_codebook(values)
    assert codebook.shape == (256,) and (np.diff(codebook) >= 0).all()
    off = np.abs(codebook[quantize(values, codebook)] - values)
    assert off.max() <= 10 / 256
    assert np.median(off) < 1e-3  # evenly spread ones would be off by .01
    np.testing.assert_array_equal(quantize(values, codebook), np.abs(codebook[None] - values[:, None]).argmin(axis=1))
    np.testing.assert_array_equal(build_codebook(np.full(7, 3.0)), np.full(256, 3.0))


def test_clustering_assigns_the_nearest_centroid(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(3000, 6)).astype(np.float32)
    few, labels = cluster_vectors(vectors)
    np.testing.assert_array_equal(few[labels], vectors)
    monkeypatch.setattr(codebooks, "CENTROIDS", 64)
    learned, labels = cluster_vectors(vectors)
    assert learned.shape == (64, 6)
    distances = np.linalg.norm(vectors[:, None] - learned[None], axis=-1)
    np.testing.assert_allclose(distances[np.arange(3000), labels], distances.min(axis=1), atol=1e-5)
    chosen = [rng.choice(vectors, 64, replace=False) for _ in range(20)]
    by_chance = [np.linalg.norm(vectors[:, None] - some[None], axis=-1).min(axis=1) for some in chosen]
    assert np.square(distances.min(axis=1)).mean() < min(np.square(off).mean() for off in by_chance)
    again, _ = cluster_vectors(vectors)
    np.testing.assert_array_equal(again, learned)


def test_values_at_a_limit_are_not_clipped() -> None:
    low, high = np.exp(-10.0), np.exp(5.9375)
    at_limits = np.float32([low, high])
    assert clipped_note("scales", np.nextafter(at_limits, np.float32([0, 1e9])), low, high) == []
    assert clipped_note("scales", 1.001 * at_limits, low, high) == [
        f"1 of 2 scales outside {low:.3g} to {high:.3g} were clipped"
    ]
