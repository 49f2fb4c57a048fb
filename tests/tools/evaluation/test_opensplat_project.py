"""What OpenSplat is given: images, cameras and points, read back by others' readers."""

from pathlib import Path

import cv2
import numpy as np
import plyfile
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.gaussians import with_colours
from idesplat.tools.evaluation.captures.peer import POINT_STRIDE, train_opensplat, write_project
from idesplat.tools.evaluation.cases import EvalCase, synthetic_case

COUNT = 100


@pytest.fixture(scope="module")
def case() -> EvalCase:
    return synthetic_case(seed=1, context=3, pool=3, targets=1, height=64, width=96)


@pytest.fixture(scope="module")
def predicted():
    rng = np.random.default_rng(0)
    means, colours = rng.normal(size=(COUNT, 3)), rng.random((COUNT, 3))
    quats = np.tile([1.0, 0, 0, 0], (COUNT, 1))
    return with_colours(means, np.full((COUNT, 3), 0.1), quats, np.full(COUNT, 0.5), colours)


def test_the_project_holds_the_views_and_every_sixteenth_point(case, predicted, tmp_path: Path) -> None:
    write_project(tmp_path, case, predicted)
    cameras = read_cameras(tmp_path / "transforms.json")
    assert len(cameras) == 3
    for view, camera in enumerate(cameras):
        np.testing.assert_allclose(camera.extrinsics, case.context.extrinsics[view], atol=1e-6)
        np.testing.assert_allclose(camera.K, case.context.K(view), rtol=1e-6)
        image = cv2.imread(str(tmp_path / camera.name))[..., ::-1] / 255
        np.testing.assert_allclose(image, case.context.image(view), atol=0.003)
    points = plyfile.PlyData.read(tmp_path / "points.ply")["vertex"]
    assert points.data.dtype.names == ("x", "y", "z", "red", "green", "blue")
    positions = np.stack([points[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(positions, predicted.means[::POINT_STRIDE], rtol=1e-6)


def test_a_trainer_that_fails_is_one_line(case, predicted) -> None:
    with pytest.raises(InputError, match="false: ended with 1") as error:
        train_opensplat(Path("/bin/false"), case, predicted, 1)
    assert "\n" not in str(error.value)
