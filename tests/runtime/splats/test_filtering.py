"""Filters of Gaussians: each on a minimal scene with a known result, and the effect on PSNR on a synthetic room."""

from pathlib import Path

import numpy as np
import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.geometry.consistency import depth_jumps, multi_view_consistency
from idesplat.runtime.geometry.quaternions import matrices_to_quaternions, quaternions_to_matrices
from idesplat.runtime.geometry.sh import SH_0
from idesplat.runtime.images.io import load_image
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.splats.filtering import FilterOptions, describe_removed, filter_gaussians
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.merging import merge_gaussians
from idesplat.runtime.splats.points import points_from_depth
from views_in_a_row import extrinsics_in_a_row

HEIGHT, WIDTH = 12, 16
ARRAYS = ("means", "scales", "quats", "opacities", "sh")
EXTRINSICS = extrinsics_in_a_row(0, 0.5)
INTRINSICS = np.tile(np.array([[1.0, 0, 0.5], [0, WIDTH / HEIGHT, 0.5], [0, 0, 1]]), (2, 1, 1))


def one_a_pixel(depth: np.ndarray, extrinsics: np.ndarray, opacity: float = 0.5) -> Gaussians:
    """A round Gaussian for each pixel, at its depth, numbered by its colour."""
    images = np.zeros((len(depth), 3, *depth.shape[1:]), np.float32)
    means = points_from_depth(depth, images, extrinsics, INTRINSICS).positions
    count = len(means)
    return Gaussians(
        means=means,
        scales=np.full((count, 3), 0.01, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacities=np.full(count, opacity, np.float32),
        sh=np.arange(count, dtype=np.float32)[:, None, None].repeat(3, axis=2),
    )


def numbers(gaussians: Gaussians) -> list[int]:
    return gaussians.sh[:, 0, 0].astype(int).tolist()


def wall(distance: float = 2.0) -> np.ndarray:
    return np.full((2, HEIGHT, WIDTH), distance, np.float32)


def test_nothing_is_asked_for_by_default() -> None:
    assert FilterOptions().enabled == []
    gaussians = one_a_pixel(wall(), EXTRINSICS)
    filters = FilterOptions()
    left, taken = filter_gaussians(gaussians, wall(), EXTRINSICS, INTRINSICS, filters)
    assert taken == {}
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(left, name), getattr(gaussians, name))


def test_faint_gaussians() -> None:
    gaussians = one_a_pixel(wall(), EXTRINSICS)
    gaussians.opacities[[3, 200]] = 0.04
    gaussians.opacities[7] = 0.05
    left, taken = filter_gaussians(
        gaussians, wall(), EXTRINSICS, INTRINSICS, FilterOptions(min_opacity=np.float32(0.05))
    )
    assert taken == {"min_opacity": 2}
    assert sorted(set(range(2 * HEIGHT * WIDTH)) - set(numbers(left))) == [3, 200]


def test_borders() -> None:
    gaussians = one_a_pixel(wall(), EXTRINSICS)
    filters = FilterOptions(crop_border=2)
    left, taken = filter_gaussians(gaussians, wall(), EXTRINSICS, INTRINSICS, filters)
    assert taken == {"crop_border": 2 * (HEIGHT * WIDTH - (HEIGHT - 4) * (WIDTH - 4))}
    rows, columns = np.divmod(np.array(numbers(left)) % (HEIGHT * WIDTH), WIDTH)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (2, HEIGHT - 3, 2, WIDTH - 3)


def test_depth_edges() -> None:
    depth = wall()
    depth[1, :, 8:] = 2.5  # a step of 25 %
    depth[0] *= 1.01 ** np.arange(WIDTH, dtype=np.float32)  # a slope of 1 % a pixel, 2 % from left to right neighbour
    jumps = depth_jumps(depth)
    np.testing.assert_allclose(jumps[0, :, 1:-1], 1.01**2 - 1, atol=1e-5)
    np.testing.assert_allclose(jumps[1, :, 7:9], 0.25, atol=1e-6)
    assert not jumps[1, :, :7].any() and not jumps[1, :, 9:].any()
    left, taken = filter_gaussians(
        one_a_pixel(depth, EXTRINSICS), depth, EXTRINSICS, INTRINSICS, FilterOptions(max_depth_jump=0.1)
    )
    assert taken == {"max_depth_jump": 2 * HEIGHT}
    assert not {HEIGHT * WIDTH + 7, HEIGHT * WIDTH + 8} & set(numbers(left))


def test_confidence_worked_by_hand() -> None:
    """Two cameras, .5 apart, before a wall at 2: what one sees at column c, the other sees 4 columns to the left."""
    depth = wall()
    depth[0, 4:8, 8:12] = 1.0  # a board in the air, which the second camera would see: 8 columns to the left, at 0 to 3
    points = points_from_depth(depth, np.zeros((2, 3, HEIGHT, WIDTH)), EXTRINSICS, INTRINSICS).positions
    given = multi_view_consistency(points.reshape(2, HEIGHT, WIDTH, 3), depth, EXTRINSICS, INTRINSICS)
    expected = np.ones((2, HEIGHT, WIDTH))
    expected[0, 4:8, 8:12] = 0  # the second camera sees the wall through it
    np.testing.assert_array_equal(
        given, expected
    )  # and of the wall behind, which the first does not see, it says nothing
    left, taken = filter_gaussians(
        one_a_pixel(depth, EXTRINSICS), depth, EXTRINSICS, INTRINSICS, FilterOptions(min_consistency=0.5)
    )
    assert taken == {"min_consistency": 16}
    assert len(left) == 2 * HEIGHT * WIDTH - 16


def test_what_is_too_far_is_denied_by_what_sees_nearer() -> None:
    depth = wall()
    depth[0, 4:8, 8:12] = 4.0  # a hole: the second camera's wall there stands where the first sees through
    points = points_from_depth(depth, np.zeros((2, 3, HEIGHT, WIDTH)), EXTRINSICS, INTRINSICS).positions
    given = multi_view_consistency(points.reshape(2, HEIGHT, WIDTH, 3), depth, EXTRINSICS, INTRINSICS)
    assert (given[0] == 1).all()  # behind the second camera's surface, which therefore does not judge
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[5:7, 9 - 4 : 11 - 4] = True  # inside the hole, away from its rim
    assert (given[1][hidden] == 0).all()
    rim = np.zeros((HEIGHT, WIDTH), bool)
    rim[4:8, 8 - 4 : 12 - 4] = True
    assert (given[1][~rim] == 1).all()


def test_the_same_surface_is_merged_once() -> None:
    """The second camera sees 12 of its 16 columns where the first does, pixel on pixel."""
    gaussians = one_a_pixel(wall(), EXTRINSICS, opacity=0.5)
    filters = FilterOptions(merge_duplicates=True)
    left, taken = filter_gaussians(gaussians, wall(), EXTRINSICS, INTRINSICS, filters)
    assert taken == {"merge_duplicates": HEIGHT * 12}
    assert len(left) == HEIGHT * WIDTH + HEIGHT * 4
    first, second = left.select(np.arange(HEIGHT * WIDTH)), left.select(np.arange(HEIGHT * WIDTH, len(left)))
    np.testing.assert_allclose(first.means, gaussians.means[: HEIGHT * WIDTH], atol=1e-6)
    opacities = first.opacities.reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(opacities[:, 4:], 1 - 0.5**2, atol=1e-6)  # what two let through, one behind the other
    np.testing.assert_array_equal(opacities[:, :4], 0.5)
    numbered = first.sh[:, 0, 0].reshape(HEIGHT, WIDTH)
    own = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(numbered[:, 4:], own[:, 4:] + (HEIGHT * WIDTH - 4) / 2, rtol=1e-6)  # the mean of both
    assert (np.array(numbers(second)) % WIDTH >= 12).all()


def test_what_was_left_out_before_is_not_merged_into() -> None:
    gaussians = one_a_pixel(wall(), EXTRINSICS)
    gaussians.opacities[: HEIGHT * WIDTH] = 0.01
    left, taken = filter_gaussians(
        gaussians, wall(), EXTRINSICS, INTRINSICS, FilterOptions(min_opacity=0.02, merge_duplicates=True)
    )
    assert taken == {"min_opacity": HEIGHT * WIDTH, "merge_duplicates": 0}
    assert numbers(left) == list(range(HEIGHT * WIDTH, 2 * HEIGHT * WIDTH))


def test_merging_keeps_the_moments() -> None:
    """Mean and covariance of the mixture, by brute force from samples' weights."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        means=rng.normal(size=(5, 3)).astype(np.float32),
        scales=rng.uniform(0.1, 1, (5, 3)).astype(np.float32),
        quats=rng.normal(size=(5, 4)).astype(np.float32),
        opacities=np.float32([0.2, 0.9, 0.5, 1.0, 0.3]),
        sh=rng.normal(size=(5, 4, 3)).astype(np.float32),
    )
    result = merge_gaussians(gaussians, np.array([0, 0, 2, 3, 0]))
    members = [0, 1, 4]
    weight = gaussians.opacities[members] / gaussians.opacities[members].sum()
    mean = weight @ gaussians.means[members]
    axes = quaternions_to_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    covariance = sum(
        w * (axes[m] @ axes[m].T + np.outer(gaussians.means[m] - mean, gaussians.means[m] - mean))
        for w, m in zip(weight, members, strict=True)
    )
    ours = quaternions_to_matrices(result.quats[:1])[0] * result.scales[0]
    np.testing.assert_allclose(result.means[0], mean, atol=1e-6)
    np.testing.assert_allclose(ours @ ours.T, covariance, atol=1e-5)
    np.testing.assert_allclose(result.opacities[0], 1 - 0.8 * 0.1 * 0.7, atol=1e-6)
    np.testing.assert_allclose(result.sh[0], np.tensordot(weight, gaussians.sh[members], 1), atol=1e-6)
    for name in ARRAYS:  # who stands alone stays as it was
        np.testing.assert_array_equal(getattr(result, name)[2:4], getattr(gaussians, name)[2:4])


def test_quaternions_and_matrices() -> None:
    quats = np.random.default_rng(0).normal(size=(200, 4))
    quats[:4] = np.eye(4)  # no turn, and half turns around the axes
    matrices = quaternions_to_matrices(quats)
    np.testing.assert_allclose(quaternions_to_matrices(matrices_to_quaternions(matrices)), matrices, atol=1e-12)


def test_the_line_names_and_counts() -> None:
    line = describe_removed({"min_opacity": 1234, "merge_duplicates": 5}, 100_000)
    assert line == "filtered: 1,234 below the opacity threshold, 5 merged into another view's; 100,000 Gaussians left"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"min_opacity": 1.5}, "--min-opacity 1.5: expected a number from 0 to 1"),
        ({"min_opacity": float("nan")}, "--min-opacity nan"),
        ({"min_consistency": -1}, "--min-consistency -1"),
        ({"crop_border": -3}, "--crop-border -3"),
        ({"max_depth_jump": float("nan")}, "--max-depth-jump nan"),
        ({"crop_border": 6}, "nothing is left of 12x16 pixels"),
        ({"min_opacity": 1}, "--min-opacity: no Gaussian is left of 384"),
    ],
)
def test_what_cannot_be_asked_for(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        filter_gaussians(one_a_pixel(wall(), EXTRINSICS), wall(), EXTRINSICS, INTRINSICS, FilterOptions(**values))


# ---- effect on PSNR


class Room:
    """Two views of the synthetic room as splats at their true depth, and a third between them to compare with."""

    def __init__(self, folder: Path) -> None:
        cameras = read_cameras(folder / "transforms.json")
        self.cameras = [cameras[index] for index in (0, 2)]
        self.between = cameras[1]
        self.image = load_image(folder / self.between.name) / 255
        self.images = np.stack([load_image(folder / camera.name) / 255 for camera in self.cameras])
        self.depth = np.stack(
            [np.load(folder / "depth" / f"{Path(camera.name).stem}.npz")["depth"] for camera in self.cameras]
        ).astype(np.float32)
        self.extrinsics = np.stack([camera.extrinsics for camera in self.cameras])
        size = np.array([self.between.width, self.between.height, 1.0])[:, None]
        self.intrinsics = np.stack([camera.K / size for camera in self.cameras])

    def splats(self, depth: np.ndarray) -> Gaussians:
        images = self.images.transpose(0, 3, 1, 2)
        means = points_from_depth(depth, images, self.extrinsics, self.intrinsics).positions
        scale = 0.5 * depth.reshape(-1, 1) / self.cameras[0].K[0, 0]
        return Gaussians(
            means=means,
            scales=np.repeat(scale, 3, axis=1).astype(np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (len(means), 1)),
            opacities=np.full(len(means), 0.9, np.float32),
            sh=((self.images.reshape(-1, 1, 3) - 0.5) / SH_0).astype(np.float32),
        )

    def psnr(self, gaussians: Gaussians) -> float:
        """Of the view between, rendered from the splats of the other two."""
        camera: Camera = self.between
        rendered = render_view(gaussians, camera.extrinsics, camera.K, camera.width, camera.height)
        return float(-10 * np.log10(np.square(np.clip(rendered.rgb, 0, 1) - self.image).mean()))


@pytest.fixture(scope="module")
def room(scene: Path) -> Room:
    return Room(scene)


def test_merging_spares_gaussians_and_no_quality(room: Room) -> None:
    whole = room.splats(room.depth)
    left, taken = filter_gaussians(
        whole, room.depth, room.extrinsics, room.intrinsics, FilterOptions(merge_duplicates=True)
    )
    assert taken["merge_duplicates"] > 0.3 * len(whole)
    assert room.psnr(left) > room.psnr(whole)


def test_doubt_finds_what_floats_in_the_air(room: Room) -> None:
    depth = room.depth.copy()
    floating = np.zeros(depth.shape, bool)
    floating[0, 30:60, 40:90] = True
    depth[floating] *= 0.6
    damaged = room.splats(depth)
    filters = FilterOptions(min_consistency=0.5)
    left, taken = filter_gaussians(damaged, depth, room.extrinsics, room.intrinsics, filters)
    assert taken["min_consistency"] > 0.5 * floating.sum()
    damaged_psnr, filtered_psnr, true_psnr = map(room.psnr, (damaged, left, room.splats(room.depth)))
    assert true_psnr > damaged_psnr + 0.5
    assert filtered_psnr > (damaged_psnr + true_psnr) / 2  # it recovers more than half of the loss
