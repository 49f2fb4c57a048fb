"""Statistics of the cameras of pairs of views: worked by hand, and of a capture of a synthetic room."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from idesplat import read_cameras
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.geometry.intrinsics import intrinsic_matrix
from idesplat.tools.evaluation.captures import camera_statistics
from idesplat.tools.evaluation.captures.camera_statistics import (
    AXES,
    BASELINE,
    CAPTURES,
    CONVERGENCE,
    FIELD_OF_VIEW,
    MIDDLE,
    QUANTILES,
    ROLL,
    SHARES,
    TRAINING,
    WHOLE_FIELD_OF_VIEW,
    capture_statistics,
    field_of_view,
    main,
    pair_statistics,
    quantiles_of,
    sample_statistics,
)
from idesplat.tools.evaluation.captures.capture import Capture, Triple
from idesplat.tools.synthetic.sampler import Sample
from views_in_a_row import extrinsics_in_a_row

NAMES = [f"{index:03}.png" for index in range(5)]


def pair(position: tuple[float, float, float], axes: np.ndarray) -> np.ndarray:
    """A camera at the origin that looks along z, and one at a position; axes: of the second, in columns."""
    extrinsics = np.tile(np.eye(4), (2, 1, 1))
    extrinsics[1, :3, :3], extrinsics[1, :3, 3] = axes, position
    return extrinsics


def test_sideways_motion() -> None:
    """One to the right at depth 2. The points at that depth are (0, 0, 2), (1, 0, 2); the middle is (0.5, 0, 2)."""
    found = pair_statistics(pair((1, 0, 0), np.eye(3)), 2.0)
    assert found[BASELINE] == 0.5
    assert found[AXES] == found[CONVERGENCE] == found[ROLL] == 0
    assert found[MIDDLE] == pytest.approx(2 * np.degrees(np.arctan(0.25)))
    assert [found[share] for share in SHARES] == [1, 0, 0]


def test_quarter_of_an_orbit() -> None:
    """About (0, 0, 2): the second camera is at (2, 0, 2), looks along -x, and its x axis is the first camera's z."""
    axes = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    found = pair_statistics(pair((2, 0, 2), axes), 2.0)
    assert found[BASELINE] == pytest.approx(np.sqrt(2))
    assert found[AXES] == pytest.approx(90) and found[MIDDLE] == pytest.approx(90)
    assert found[CONVERGENCE] == pytest.approx(1)
    assert found[ROLL] == 0
    assert [found[share] for share in SHARES] == pytest.approx([0.5, 0, 0.5])


def test_forward_motion_with_roll() -> None:
    """Forward by 1 with 30 degrees of roll. The points at depth 2 are (0, 0, 2), (0, 0, 3): no angle at the middle."""
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    found = pair_statistics(pair((0, 0, 1), np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])), 2.0)
    assert found[ROLL] == pytest.approx(30)
    assert found[AXES] == found[MIDDLE] == found[CONVERGENCE] == 0
    assert [found[share] for share in SHARES] == [0, 0, 1]


def test_diverging_cameras_have_negative_convergence() -> None:
    """One to the right, which looks along x: 1 * ((0, 0, 1) - (1, 0, 0)) . (1, 0, 0) / 1 = -1."""
    axes = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    assert pair_statistics(pair((1, 0, 0), axes), 1.0)[CONVERGENCE] == -1


def test_statistics_do_not_depend_on_the_order_or_the_unit() -> None:
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    extrinsics = pair((0.3, -0.2, 0.1), rotation * np.linalg.det(rotation))
    scaled = extrinsics[::-1].copy()
    scaled[:, :3, 3] *= 7
    assert pair_statistics(scaled, 7 * 1.5) == pytest.approx(pair_statistics(extrinsics, 1.5))


def test_the_field_of_view_is_that_of_the_longer_side() -> None:
    assert field_of_view(intrinsic_matrix(200, 1, 0, 0), 400, 300) == pytest.approx(90)
    assert field_of_view(intrinsic_matrix(1, 150, 0, 0), 200, 300) == pytest.approx(90)


def test_quantiles_of_pairs() -> None:
    pairs = [{BASELINE: float(value)} for value in range(11)]
    assert quantiles_of(pairs) == {BASELINE: [1, 5, 9]}


def test_a_sample_gives_its_neighbouring_context_views() -> None:
    """Views at x = 0, 1, 3 and a target at 9, of depths 1, 3, 5: the medians of neighbours are 2 and 4."""
    extrinsics = extrinsics_in_a_row(0, 1, 3, 9).astype(np.float32)
    depth = np.ones((4, 2, 4), np.float32) * np.array([1, 3, 5, 7], np.float32)[:, None, None]
    intrinsics = np.tile(np.array([[0.5, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], np.float32), (4, 1, 1))
    sample = Sample(np.zeros((4, 3, 2, 4), np.float32), depth, extrinsics, intrinsics, 1.0, 8.0, 3)
    found = list(sample_statistics(sample))
    assert [view[BASELINE] for view in found] == [1 / 2, 2 / 4]
    assert [view[FIELD_OF_VIEW] for view in found] == pytest.approx([90, 90])


@pytest.fixture
def room(scene: Path, monkeypatch: pytest.MonkeyPatch) -> Capture:
    """The only capture: the scene, with a triple and a path of three views."""
    cameras = {
        Path(camera.name).name: Camera(camera.name, camera.width, camera.height, camera.K, camera.extrinsics)
        for camera in read_cameras(scene / "transforms.json")
    }
    triple = Triple((NAMES[0], NAMES[2]), NAMES[1])
    capture = Capture("room", "", "", "", "someone/room", "", "", cameras, [triple], NAMES[::2], NAMES[1::2])

    @contextmanager
    def frames_of(*_: object) -> Iterator[Path]:
        yield scene / "images"

    monkeypatch.setattr(camera_statistics, "frames_of", frames_of)
    monkeypatch.setattr(camera_statistics, "read_captures", lambda _: [capture])
    return capture


def test_a_capture_is_measured_at_the_depth_of_its_matches(room: Capture, scene: Path) -> None:
    (found,) = capture_statistics(room, scene)
    first, second = (room.cameras[name] for name in room.triples[0].context)
    depth = np.linalg.norm(second.extrinsics[:3, 3] - first.extrinsics[:3, 3]) / found[BASELINE]
    truth = [np.load(scene / "depth" / name.replace(".png", ".npz"))["depth"] for name in room.triples[0].context]
    assert np.quantile(truth, 0.1) < depth < np.quantile(truth, 0.9)
    # The longer side of 128 x 96 pixels is cropped to 96 pixels.
    half = np.tan(np.radians([found[FIELD_OF_VIEW] / 2, found[WHOLE_FIELD_OF_VIEW] / 2]))
    assert half[0] / half[1] == pytest.approx(96 / 128, rel=1e-3)
    assert len(list(capture_statistics(room, scene, views=3))) == 2


def test_the_command_writes_what_it_prints(room: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "statistics.json"
    assert run_command(main, "--checkouts", tmp_path, "--samples", 3, "--json", path) == 0
    content = json.loads(path.read_text())
    assert content["pairs"] == {CAPTURES: 1, TRAINING: 3}
    printed = capsys.readouterr().out
    for name, values in content["quantiles"][TRAINING].items():
        assert len(values) == len(QUANTILES) and values == sorted(values)
        assert name in printed
    assert f"{content['quantiles'][CAPTURES][BASELINE][1]:.3g}" in printed
