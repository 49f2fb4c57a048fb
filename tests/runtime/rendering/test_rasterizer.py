"""The rasteriser against gsplat's reference images, and against a slow reference implementation.

Both kernels are tested: NumPy, and compiled by numba.
"""

import itertools
import subprocess
import sys
import threading
import tracemalloc
from math import cos, exp, factorial, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.rendering import rasterizer, rasterizer_numpy
from idesplat.runtime.rendering import rasterizer_numba as rasterizer_compiled
from idesplat.runtime.rendering.rasterizer import rasterize
from idesplat.runtime.rendering.types import Rendering

DATA = Path(__file__).parent.parent.parent / "data"
STEPS = {"numpy": rasterizer_numpy, "compiled": rasterizer_compiled}

LENSES = ({}, {"aperture": 0.2, "focus": 2.0}, {"aperture": 0.05, "focus": np.inf})


def use_steps(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(rasterizer, "_kernels", lambda: STEPS[name])


@pytest.fixture(params=STEPS)
def steps(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Render with NumPy, then compiled."""
    use_steps(monkeypatch, request.param)
    return request.param


def reference_case(case: str) -> tuple:
    """A reference scene as the arguments of `rasterize`."""
    with np.load(DATA / f"raster-{case}" / "reference.npz") as file:
        arrays = [file[name] for name in ("means", "quats", "scales", "opacities", "sh", "viewmat", "K")]
        return *arrays, int(file["width"]), int(file["height"]), file["background"]


@pytest.mark.usefixtures("steps")
@pytest.mark.parametrize("case", ["random", "feedforward"])
def test_matches_gsplat(case: str) -> None:
    reference = np.load(DATA / f"raster-{case}" / "reference.npz")
    rendered = rasterize(*reference_case(case))
    for name in Rendering._fields:
        ours, theirs = getattr(rendered, name), reference[name]
        assert ours.dtype == np.float32
        assert ours.shape == theirs.shape
        error = ours.astype(np.float64) - theirs
        assert np.abs(error).max() <= 1e-2, name
        assert 10 * np.log10(1 / np.mean(error**2)) >= 110, name  # dB; rounding to float32 leaves 130 to 150


@pytest.mark.parametrize("case", ["random", "feedforward", *range(24)])
@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_compiled_matches_numpy(case: str | int, lens: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    if isinstance(case, str):
        scene = reference_case(case)
    else:
        scene = random_scene(np.random.default_rng(1000 + case), splats=500, degree=case % 4)
    use_steps(monkeypatch, "numpy")
    expected = rasterize(*scene, **lens)
    use_steps(monkeypatch, "compiled")
    rendered = rasterize(*scene, **lens)
    for name in Rendering._fields:
        theirs = getattr(expected, name)
        # Depth is in scene units, so its rounding grows with it; the others reach 1.
        np.testing.assert_allclose(
            getattr(rendered, name), theirs, rtol=0, atol=1e-5 * max(1, theirs.max()), err_msg=name
        )


def test_depths_are_sorted_as_numpy_sorts_them() -> None:
    rng = np.random.default_rng(0)
    depth = np.repeat(np.exp(rng.uniform(-80, 80, 500)).astype(np.float32), 3)
    rng.shuffle(depth)
    np.testing.assert_array_equal(rasterizer._argsort_depth(depth), np.argsort(depth, kind="stable"))
    assert len(rasterizer._argsort_depth(depth[:0])) == 0


@pytest.mark.usefixtures("steps")
@pytest.mark.parametrize("seed", range(24))
@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_matches_slow_reference(seed: int, lens: dict[str, float]) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, splats=int(rng.integers(1, 120)), degree=seed % 4)
    rendered = rasterize(*scene, **lens)
    expected = slow_rasterize(*scene, **lens)
    for name in Rendering._fields:
        # A hundred float32 roundings of numbers up to the farthest depth, 8.
        np.testing.assert_allclose(getattr(rendered, name), expected[name], rtol=0, atol=100 * 8 * 6e-8, err_msg=name)


def test_many_chunks_give_what_one_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels carry their transmittance from chunk to chunk, and stay closed once opaque."""
    use_steps(monkeypatch, "numpy")
    scene = random_scene(np.random.default_rng(5), splats=400, degree=1)
    whole = rasterize(*scene)
    assert whole.alpha.max() > 0.999
    monkeypatch.setattr("idesplat.runtime.rendering.rasterizer_numpy.CHUNK_FRAGMENTS", 500)
    monkeypatch.setattr("idesplat.runtime.rendering.rasterizer.BLOCK_SIZE", 64)
    monkeypatch.setattr("idesplat.runtime.rendering.rasterizer_numpy.BLOCK_SIZE", 64)
    pieces = rasterize(*scene)
    for ours, theirs in zip(pieces, whole, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=5e-5)


@pytest.mark.usefixtures("steps")
def test_nothing_to_render_shows_the_background() -> None:
    empty = gaussians_at(np.zeros((0, 3)))
    behind = gaussians_at(np.array([[0, 0, -2.0], [0.1, 0, -0.5], [0, 0, 0.005]]))
    beside = gaussians_at(np.array([[500.0, 0, 1.0], [0, -500.0, 1.0]]))
    for gaussians in (empty, behind, beside):
        rgb, alpha, depth = rasterize(*gaussians, np.eye(4), pinhole(20, 12), 20, 12, (0.1, 0.2, 0.3))
        assert rgb.shape == (12, 20, 3)
        np.testing.assert_array_equal(rgb, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (12, 20, 3)))
        assert not alpha.any()
        assert not depth.any()


@pytest.mark.usefixtures("steps")
def test_one_opaque_splat_worked_by_hand() -> None:
    """A splat at depth 2 over the centre of pixel (row 3, column 5): alpha is clamped at 0.99 there."""
    K = np.array([[10.0, 0, 5.5], [0, 10.0, 3.5], [0, 0, 1]])
    means, quats, scales, _, sh = gaussians_at(np.array([[0, 0, 2.0]]))
    rgb, alpha, depth = rasterize(means, quats, scales, np.ones(1), sh, np.eye(4), K, 11, 7)
    assert alpha[3, 5] == pytest.approx(0.99, abs=1e-6)
    assert depth[3, 5] == pytest.approx(1.98, abs=1e-6)
    np.testing.assert_allclose(rgb[3, 5], 0.99 * 0.5, atol=1e-6)  # sh of zero is the colour 0.5
    variance = (10 / 2 * 0.1) ** 2 + 0.3
    assert alpha[3, 7] == pytest.approx(exp(-0.5 * 2**2 / variance), rel=1e-5)


@pytest.mark.usefixtures("steps")
def test_the_third_opaque_splat_is_dropped() -> None:
    """Two splats at the clamp leave 0.01^2 of the light, in doubles a hair more than 1e-4; a third would leave 1e-6."""
    means, quats, scales, _, sh = gaussians_at(np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]]))
    K = np.array([[10.0, 0, 0.5], [0, 10.0, 0.5], [0, 0, 1]])
    _, alpha, depth = rasterize(means, quats, scales, np.ones(3), sh, np.eye(4), K, 1, 1)
    assert alpha[0, 0] == pytest.approx(0.99 + 0.0099, abs=1e-6)
    assert depth[0, 0] == pytest.approx(0.99 * 2 + 0.0099 * 3, abs=1e-6)


@pytest.mark.usefixtures("steps")
def test_near_plane_is_the_callers() -> None:
    gaussians = gaussians_at(np.array([[0, 0, 0.1]]))
    camera = (np.eye(4), pinhole(8, 8), 8, 8)
    assert rasterize(*gaussians, *camera).alpha.max() > 0.1
    assert not rasterize(*gaussians, *camera, near=0.2).alpha.any()


@pytest.mark.usefixtures("steps")
def test_needles_and_extremes_stay_finite() -> None:
    rng = np.random.default_rng(1)
    means = rng.normal(size=(60, 3)) * [1, 1, 0.01] + [0, 0, 0.02]
    means[0] = 3e38, 3e38, 3e38
    means[1] = 1e20, 0, 0.02
    scales = 10.0 ** rng.uniform(-30, 30, (60, 3))
    quats = rng.normal(size=(60, 4))
    quats[2] = 0
    camera = np.eye(4), pinhole(64, 48), 64, 48
    for lens in ({}, {"aperture": 1e30, "focus": 1e-30}, {"aperture": 1e-30, "focus": 0.01}):
        rendered = rasterize(means, quats, scales, rng.uniform(size=60), np.zeros((60, 4, 3)), *camera, **lens)
        for image in rendered:
            assert np.isfinite(image).all()
        assert rendered.alpha.max() <= 1


@pytest.mark.usefixtures("steps")
def test_memory_does_not_grow_with_overdraw() -> None:
    """300 veils over the whole image are 23 million fragments; at some 60 bytes each they would take 1.4 GB at once."""
    means, quats, _, _, sh = gaussians_at(np.random.default_rng(0).normal(size=(300, 3)) * 0.01 + [0, 0, 5])
    tracemalloc.start()
    rendered = rasterize(
        means, quats, np.full((300, 3), 50.0), np.full(300, 0.005), sh, np.eye(4), pinhole(320, 240), 320, 240
    )
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(rendered.alpha, 1 - 0.995**300, atol=1e-2)
    assert peak < 250e6


def test_pixel_sized_splats_cost_no_python_call_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """With NumPy, the number of calls is far below the number of splats: everything is done in arrays."""
    use_steps(monkeypatch, "numpy")
    rng = np.random.default_rng(0)
    rows, columns = np.divmod(np.arange(2 * 256 * 256) % 65536, 256)
    z = rng.uniform(1.5, 3, 131072)
    means = np.stack([(columns - 127.5) / 230 * z, (rows - 127.5) / 230 * z, z], axis=1)
    scales = (z / 230)[:, None] * rng.uniform(0.3, 1, (131072, 3))
    opacities, sh = rng.uniform(0.05, 0.95, 131072), rng.normal(size=(131072, 9, 3)) * 0.2
    arguments = means, rng.normal(size=(131072, 4)), scales, opacities, sh, np.eye(4), pinhole(256, 256), 256, 256
    calls = itertools.count()
    threading.setprofile(lambda *_: next(calls))  # of the pool's threads
    try:
        rasterize(*arguments)
    finally:
        threading.setprofile(None)
    assert 100 < next(calls) < 13_000


VALID = {
    "means": np.zeros((2, 3)) + 1,
    "quats": np.ones((2, 4)),
    "scales": np.ones((2, 3)),
    "opacities": np.ones(2),
    "sh": np.zeros((2, 4, 3)),
    "viewmat": np.eye(4),
    "K": np.array([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]),
    "width": 8,
    "height": 6,
    "background": np.zeros(3),
}


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh", "viewmat", "K", "background"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_values_that_are_not_finite_are_refused(name: str, value: float) -> None:
    if name in ("viewmat", "K") and value == 1e300:
        value = -np.inf
    array = VALID[name].copy()
    array.flat[0] = value
    with pytest.raises(InputError, match=rf"rasterize: {name} .*not finite"):
        rasterize(**VALID | {name: array})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", np.zeros((2, 2)), r"means has shape \(2, 2\), expected \(2, 3\)"),
        ("means", np.zeros((3, 3)), r"quats has shape \(2, 4\), expected \(3, 4\)"),
        ("means", 1.0, "means has shape"),
        ("means", np.full((2, 3), "a"), "means holds .* expected real numbers"),
        ("quats", np.zeros((2, 3)), "quats has shape"),
        ("scales", np.zeros(2), "scales has shape"),
        ("opacities", np.zeros((2, 1)), "opacities has shape"),
        ("sh", np.zeros((2, 3)), r"sh has shape \(2, 3\), expected \(2, 1, 3\)"),
        ("sh", np.zeros((2, 5, 3)), "5 coefficients, expected 1, 4, 9 or 16"),
        ("sh", np.zeros((2, 25, 3)), "25 coefficients"),
        ("viewmat", np.eye(3), r"viewmat has shape \(3, 3\), expected \(4, 4\)"),
        ("K", np.eye(4), "K has shape"),
        ("K", np.diag([-1.0, 1, 1]), "fx, fy > 0"),
        ("K", np.array([[10, 1, 4], [0, 10, 3], [0, 0, 1.0]]), "K is"),
        ("width", 0, "image is 0x6"),
        ("height", 70000, "image is 8x70000"),
        ("near", 0.0, "near is 0.0"),
        ("near", np.nan, "near is nan"),
        ("background", (0, 0), "background has shape"),
        ("aperture", -0.1, "aperture is -0.1, expected a diameter in world units, 0 to"),
        ("aperture", np.nan, "aperture is nan"),
        ("aperture", np.inf, "aperture is inf"),
        ("aperture", 0.1, "focus is missing; give the z-depth"),
        ("focus", 0.0, "focus is 0.0, expected a positive z-depth"),
        ("focus", -2.0, "focus is -2.0"),
        ("focus", np.nan, "focus is nan"),
    ],
)
def test_wrong_arguments_are_named(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        rasterize(**VALID | {name: value})


def test_an_image_too_large_for_memory_is_refused() -> None:
    with pytest.raises(InputError, match=r"image is 60000x60000, expected at most \d+ pixels"):
        rasterize(**VALID | {"width": 60000, "height": 60000})


def test_package_exports_rasterize_without_loading_it() -> None:
    program = (
        "import sys, idesplat.runtime as runtime\n"
        "assert 'numpy' not in sys.modules\n"
        "assert runtime.rasterize.__module__ == 'idesplat.runtime.rendering.rasterizer'\n"
        "assert not hasattr(runtime, 'rasterise')\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def pinhole(width: int, height: int) -> np.ndarray:
    return np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])


def gaussians_at(means: np.ndarray) -> tuple[np.ndarray, ...]:
    """Grey balls of radius 0.1, half opaque."""
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return means, quats, np.full((count, 3), 0.1), np.full(count, 0.5), np.zeros((count, 1, 3))


def random_scene(rng: np.random.Generator, splats: int, degree: int) -> tuple:
    """Splats of all sizes and opacities in front of, beside and behind a tilted camera with an off-centre axis."""
    width, height = (int(side) for side in rng.integers(9, 60, 2))
    means = rng.uniform([-3, -3, -1], [3, 3, 6], (splats, 3))
    scales = np.exp(rng.uniform(np.log(3e-3), np.log(1.0), (splats, 3)))
    opacities = rng.choice([1.0, 0.004, 0.5], splats) * rng.uniform(0.5, 1, splats)
    opacities[rng.uniform(size=splats) < 0.3] = 1.0
    sh = rng.normal(size=(splats, (degree + 1) ** 2, 3)) * 0.5
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)) * 0.2 + np.eye(3))
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation * np.sign(rotation.diagonal())
    viewmat[:3, 3] = rng.normal(size=3) * 0.3
    focal = rng.uniform(0.5, 1.5, 2) * width
    K = np.array(
        [[focal[0], 0, width * rng.uniform(0.2, 0.8)], [0, focal[1], height * rng.uniform(0.2, 0.8)], [0, 0, 1]]
    )
    arrays = (means, rng.normal(size=(splats, 4)), scales, opacities, sh)
    arrays = tuple(array.astype(np.float32) for array in arrays)  # so that both see the same numbers
    return *arrays, viewmat, K, width, height, rng.uniform(size=3).astype(np.float32)


def slow_rasterize(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    background: np.ndarray,
    aperture: float = 0,
    focus: float = np.inf,
) -> dict[str, np.ndarray]:
    """What `rasterize` computes, one splat after another over the whole image, in float64."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    world_to_camera, translation = viewmat[:3, :3], viewmat[:3, 3]
    camera_position = -world_to_camera.T @ translation
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rgb, alpha_sum, depth = np.zeros((height, width, 3)), np.zeros((height, width)), np.zeros((height, width))
    transmittance, closed = np.ones((height, width)), np.zeros((height, width), bool)

    points = means.astype(np.float64) @ world_to_camera.T + translation
    for index in np.argsort(points[:, 2], kind="stable"):
        x, y, z = points[index]
        if z <= 0.01:
            continue
        axes = rotation_matrix(quats[index].astype(np.float64)) @ np.diag(scales[index].astype(np.float64))
        covariance = world_to_camera @ axes @ axes.T @ world_to_camera.T
        x_clamped = z * np.clip(x / z, -cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
        y_clamped = z * np.clip(y / z, -cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
        jacobian = np.array([[fx / z, 0, -fx * x_clamped / z**2], [0, fy / z, -fy * y_clamped / z**2]])
        focused = jacobian @ covariance @ jacobian.T + 0.3 * np.eye(2)
        circle = aperture * abs(1 / focus - 1 / z) * np.array([fx, fy])  # its diameters along x and y
        blurred = focused + np.diag(circle**2 / 16)
        conic, fading = np.linalg.inv(blurred), sqrt(np.linalg.det(focused) / np.linalg.det(blurred))

        dx, dy = column - (fx * x / z + cx), row - (fy * y / z + cy)
        sigma = 0.5 * (conic[0, 0] * dx**2 + conic[1, 1] * dy**2) + conic[0, 1] * dx * dy
        alpha = np.minimum(0.99, float(opacities[index]) * np.exp(-sigma))
        visible = (alpha >= 1 / 255) & ~closed
        alpha = alpha * fading
        passed = transmittance * (1 - alpha)
        closed |= visible & (passed <= 1e-4)
        weight = np.where(visible & ~closed, alpha * transmittance, 0)
        transmittance = np.where(visible & ~closed, passed, transmittance)

        direction = means[index] - camera_position
        colour = sh_basis(direction / np.linalg.norm(direction), sh.shape[1]) @ sh[index] + 0.5
        rgb += weight[..., None] * np.maximum(colour, 0)
        alpha_sum += weight
        depth += weight * z
    return {"rgb": rgb + (1 - alpha_sum[..., None]) * background, "alpha": alpha_sum, "depth": depth}


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Rodrigues' formula on the axis and angle of a wxyz quaternion."""
    w, axis = quat[0] / np.linalg.norm(quat), quat[1:] / np.linalg.norm(quat)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def sh_basis(direction: np.ndarray, coefficients: int) -> np.ndarray:
    """Real spherical harmonics from their definition, with the Condon-Shortley phase, in order of degree then order."""
    x, y, z = direction
    azimuth = np.arctan2(y, x)
    values = []
    for degree in range(int(sqrt(coefficients))):
        for order in range(-degree, degree + 1):
            m = abs(order)
            legendre = np.polynomial.Legendre.basis(degree)
            legendre = legendre.deriv(m) if m else legendre
            associated = (-1) ** m * (1 - z * z) ** (m / 2) * legendre(z)
            norm = sqrt((2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m))
            turn = sqrt(2) * sin(m * azimuth) if order < 0 else sqrt(2) * cos(m * azimuth) if order else 1
            values.append(norm * associated * turn)
    return np.array(values)
