"""The choice between a relief and its reversal, on reconstructions whose true cameras are known."""

import numpy as np
import pytest
from idesplat.runtime.sfm.relief import _adjust, _error, _reverse, reversed_relief

pycolmap = pytest.importorskip("pycolmap")
WIDTH, HEIGHT, FOCAL = 640, 480, 560.0
NOISE = 0.2  # pixels, of a measured point


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def ground(rng: np.random.Generator, count: int = 500) -> np.ndarray:
    """Points of hilly ground seen from the air at an angle: far ones at the top of the image, [count, 3]."""
    x, y = rng.uniform(-0.5, 0.5, count), rng.uniform(-0.4, 0.4, count)
    z = 10 - 12 * y + rng.uniform(-0.5, 0.5, count)
    return np.stack([x * z, y * z, z], axis=-1)


def flight(images: int) -> list[np.ndarray]:
    """Camera-from-world matrices of a camera that flies forward over the ground, [3, 4] each."""
    return [np.hstack([np.eye(3), -np.array([[0.1], [-0.25], [0.35]]) * step]) for step in range(images)]


def orbit(images: int, degrees: float) -> list[np.ndarray]:
    """Camera-from-world matrices of cameras around a point at depth 10."""
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, images))
    matrices = []
    for angle in angles:
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        centre = np.array([0, 0, 10.0])
        matrices.append(np.hstack([rotation, (centre - rotation @ centre)[:, None]]))
    return matrices


def reconstruct(points: np.ndarray, poses: list[np.ndarray], rng: np.random.Generator) -> pycolmap.Reconstruction:
    """A reconstruction of these points and poses, with noisy measurements in every image that shows a point."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for number, pose in enumerate(poses, start=1):
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        pixels = FOCAL * in_camera[:, :2] / in_camera[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        seen = np.flatnonzero((in_camera[:, 2] > 0) & np.all((pixels > 0) & (pixels < [WIDTH, HEIGHT]), axis=1))
        image = pycolmap.Image(name=f"{number:06}", camera_id=1, image_id=number)
        image.points2D = [pycolmap.Point2D(pixels[point] + rng.normal(0, NOISE, 2)) for point in seen]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for place, point in enumerate(seen):
            tracks[point].append((number, place))
    for point, track in zip(points, tracks, strict=True):
        if len(track) > 1:
            elements = [pycolmap.TrackElement(*element) for element in track]
            model.add_point3D(point, pycolmap.Track(elements), np.zeros(3, np.uint8))
    return model


def turns(model: pycolmap.Reconstruction) -> list[float]:
    """Degrees by which each image is turned from the first."""
    poses = [image.cam_from_world().rotation for image in sorted(model.images.values(), key=lambda image: image.name)]
    return [float(np.degrees((pose * poses[0].inverse()).angle())) for pose in poses]


def test_a_reversed_relief_is_found_and_the_right_one_kept(rng: np.random.Generator) -> None:
    right = reconstruct(ground(rng), flight(8), rng)
    wrong = pycolmap.Reconstruction(right)
    _reverse(wrong)
    _adjust(wrong, refine_focal=True)  # as the mapper does, which stays in the wrong relief
    assert _error(wrong) > 3 * NOISE
    assert max(turns(wrong)) > 3  # the camera did not turn

    found = reversed_relief(wrong, refine_focal=True)

    assert found is not None
    assert _error(found) < 1.5 * NOISE
    assert max(turns(found)) < 0.5
    assert reversed_relief(right, refine_focal=True) is None


def test_a_focal_length_that_is_given_stays(rng: np.random.Generator) -> None:
    wrong = reconstruct(ground(rng), flight(8), rng)
    _reverse(wrong)

    found = reversed_relief(wrong, refine_focal=False)

    assert found is not None
    assert [camera.params[0] for camera in found.cameras.values()] == [FOCAL]


@pytest.mark.parametrize("degrees", [20, 120])
def test_an_orbit_stays_as_it_is(degrees: float, rng: np.random.Generator) -> None:
    points = np.stack([rng.uniform(-2, 2, 300), rng.uniform(-2, 2, 300), 10 + rng.uniform(-2, 2, 300)], axis=-1)

    assert reversed_relief(reconstruct(points, orbit(8, degrees), rng), refine_focal=True) is None


def test_too_few_points_tell_nothing(rng: np.random.Generator) -> None:
    wrong = reconstruct(ground(rng, 40), flight(8), rng)
    _reverse(wrong)

    assert reversed_relief(wrong, refine_focal=True) is None
