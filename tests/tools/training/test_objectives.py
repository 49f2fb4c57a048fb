"""Optional terms of the training loss, against values worked out by hand and libraries."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from idesplat.model.common.gaussian_adapter import WorldGaussians
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.errors import InputError
from idesplat.runtime.rendering.rasterizer import rasterize as runtime_rasterize
from idesplat.runtime.rendering.types import MIN_ALPHA
from idesplat.runtime.views.loader import load_view
from idesplat.runtime.views.matching import PointMatches
from idesplat.tools.synthetic.sampler import VALIDATION_SEEDS
from idesplat.tools.training import step
from idesplat.tools.training.data.pointmaps import check_pointmap, load_pointmap, pointmap_path
from idesplat.tools.training.data.samples import SampleSpec
from idesplat.tools.training.data.synthetic import generate_views
from idesplat.tools.training.objectives.consistency import (
    EPIPOLAR_SCALE,
    RATIO_SCALE,
    RATIO_WEIGHT,
    consistency_loss,
    match_views,
    matched_loss,
    with_matches,
)
from idesplat.tools.training.objectives.defocus import (
    C1,
    OUT_OF_FOCUS_WEIGHT,
    SSIM_WEIGHT,
    compare_defocused,
    focused_depth,
    ssim_map,
)
from idesplat.tools.training.objectives.pointmap import exact_pointmap, pointmap_loss, umeyama
from idesplat.tools.training.options import OptionalTerms
from idesplat.tools.training.rasterizer import rasterize
from idesplat.tools.training.settings import TrainingSettings, network_config
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]])
SETTINGS = TrainingSettings(
    "idesplat-tiny", "both", True, steps=8, batch=2, size=256, lr=1e-3, vit_lr=5e-4, seed=3, init="", data=[]
)


def test_umeyama_finds_the_similarity() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(50, 3))
    rotation = Rotation.from_euler("xyz", (0.3, -1.0, 2.0)).as_matrix()
    scale, found, translation = umeyama(source, 2.5 * source @ rotation.T + (1, 2, 3))
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(found, rotation, atol=1e-6)
    np.testing.assert_allclose(translation, (1, 2, 3), atol=1e-6)


def test_pointmap_loss_ignores_a_similarity_and_unknown_points() -> None:
    means = torch.from_numpy(SQUARE).float()
    turned = 3 * means @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 7
    unknown = torch.cat([turned, torch.full((1, 3), torch.nan)])
    assert float(pointmap_loss(torch.cat([means, torch.tensor([[9.0, 9, 9]])]), unknown)) < 1e-9
    assert float(pointmap_loss(means, torch.full((4, 3), torch.nan))) == 0


def test_pointmap_loss_by_hand() -> None:
    """A symmetric error of the corners keeps the alignment at the identity: each mean is 0.1 from its nearest point."""
    means = torch.from_numpy(SQUARE).float()
    means[:, 2] = 0.1 * torch.tensor([1.0, -1, -1, 1])
    means.requires_grad_()
    loss = pointmap_loss(means, torch.from_numpy(SQUARE).float())
    assert float(loss.detach()) == pytest.approx(0.01, rel=1e-3)
    loss.backward()
    assert means.grad is not None
    torch.testing.assert_close(means.grad[:, 2], means.detach()[:, 2] / 2, rtol=1e-3, atol=1e-6)


def test_a_mean_is_compared_with_the_nearest_point() -> None:
    """The last mean lies at another pixel's point: Chamfer's distance is 0 there, where its own is 2."""
    points = torch.from_numpy(np.concatenate([SQUARE] * 50)).float()
    means = points.clone()
    means[-1] = points[0]
    assert float(pointmap_loss(means, points)) < 1e-3


def test_exact_pointmap_projects_to_its_own_pixels() -> None:
    views = generate_views(SampleSpec(11, 2, (), 32, 48))
    points = exact_pointmap(views).reshape(2, 32, 48, 3)
    camera = (points[1, 5, 7] - views.extrinsics[1, :3, 3]) @ views.extrinsics[1, :3, :3]
    x, y, _ = (views.intrinsics[1] @ camera / camera[2]).tolist()
    assert (x * 48, y * 32) == pytest.approx((7.5, 5.5), abs=1e-3)
    assert views.inverse_depth is not None
    assert float(camera[2] * views.inverse_depth[1, 5, 7]) == pytest.approx(1, rel=1e-4)


def test_consistency_by_hand() -> None:
    """One point at (0, 0, 4), seen by a second camera at x = 1; the first view predicts the depth 5, the second 4."""
    K = torch.tensor([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    second_from_first = np.eye(4)
    second_from_first[0, 3] = -1
    matches = PointMatches(np.array([[0.0, 0]]), np.array([[-0.25, 0]]), second_from_first)
    first, second = torch.full((8, 8), 5.0), torch.full((8, 8), 4.0)
    distance = 8 * (0.25 - 1 / 5)  # pixels
    expected = EPIPOLAR_SCALE * math.log(1 + distance / EPIPOLAR_SCALE)
    expected += RATIO_WEIGHT * RATIO_SCALE * math.log(1 + math.log(5 / 4) / RATIO_SCALE)
    assert float(matched_loss(first, second, K, K, matches)[0]) == pytest.approx(expected, rel=1e-5)
    assert float(matched_loss(second, second, K, K, matches)[0]) == pytest.approx(0, abs=1e-5)


def test_true_depth_is_consistent_and_wrong_depth_is_not() -> None:
    views = generate_views(SampleSpec(VALIDATION_SEEDS[0], 2, (), 128, 128))  # a scene that never changes
    views = replace(views, matches=(match_views(views),))
    assert views.inverse_depth is not None
    true = 1 / views.inverse_depth
    assert float(consistency_loss(true, views)) < 0.5 * float(consistency_loss(1.25 * true, views))
    assert match_views(replace(views, images=torch.zeros_like(views.images))) == ()
    assert float(consistency_loss(true, replace(views, matches=((),)))) == 0
    second_from_first = np.eye(4)
    second_from_first[0, 3] = -1
    behind = PointMatches(np.array([[0.0, 0]]), np.array([[0.25, 0]]), second_from_first)  # the rays meet at z = -4
    assert float(consistency_loss(true, replace(views, matches=(((0, 1, behind),),)))) == 0


def scene() -> list[torch.Tensor]:
    rng = np.random.default_rng(0)
    means = rng.uniform((-1, -1, 2), (1, 1, 6), (40, 3))
    parts = (
        means,
        rng.normal(size=(40, 4)),
        np.exp(rng.uniform(-4, -1, (40, 3))),
        rng.uniform(0.2, 0.9, 40),
        rng.normal(size=(40, 4, 3)),
    )
    return [torch.from_numpy(part) for part in parts]


def test_a_lens_blurs_as_in_the_runtime() -> None:
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    parts = scene()
    ours, alpha, _ = rasterize(
        *parts, torch.eye(4).double(), torch.from_numpy(K), 64, 48, torch.zeros(3).double(), aperture=0.2, focus=3.0
    )
    means, quats, scales, opacities, sh = (part.numpy().astype(np.float32) for part in parts)
    expected = runtime_rasterize(means, quats, scales, opacities, sh, np.eye(4), K, 64, 48, aperture=0.2, focus=3.0)
    error = np.abs(ours.numpy() - expected.rgb)
    assert np.median(error) < 1e-6
    assert error.max() < 2 * MIN_ALPHA  # where one of them leaves out a fragment at MIN_ALPHA
    pinhole = rasterize(*parts, torch.eye(4).double(), torch.from_numpy(K), 64, 48, torch.zeros(3).double())[0]
    assert float((ours - pinhole).abs().max()) > 0.05
    assert float(alpha.max()) <= 1


def test_ssim_is_that_of_scikit_image() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 40, 40))
    expected = structural_similarity(
        first, second, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, full=True
    )[1]
    found = ssim_map(*(torch.from_numpy(x)[None, None] for x in (first, second)))[0, 0].numpy()
    np.testing.assert_allclose(found[5:-5, 5:-5], expected[5:-5, 5:-5], atol=1e-6)


def test_defocus_by_hand() -> None:
    """Constant images of 0.5 and 0.6, in focus on the left half alone."""
    rendered, image = torch.full((3, 32, 32), 0.5), torch.full((3, 32, 32), 0.6)
    confusion = torch.zeros(32, 32)
    confusion[:, 16:] = 3.0
    ssim = (2 * 0.5 * 0.6 + C1) / (0.5**2 + 0.6**2 + C1)
    expected = (1 - SSIM_WEIGHT) * 0.1 + SSIM_WEIGHT * (1 - ssim) + OUT_OF_FOCUS_WEIGHT * 0.1
    assert float(compare_defocused(rendered, image, confusion)) == pytest.approx(expected, rel=1e-3)
    assert float(compare_defocused(image, image, confusion)) == pytest.approx(0, abs=1e-5)


def test_focus_is_where_the_image_is_sharp() -> None:
    """Noise at the depth 2 on the left, a flat colour at the depth 9 on the right."""
    image = torch.full((3, 32, 32), 0.5)
    image[:, :, :12] = torch.rand(3, 32, 12, generator=torch.Generator().manual_seed(0))
    depth = torch.full((32, 32), 9.0)
    depth[:, :14] = 2.0
    assert focused_depth(image, depth) == 2.0


def test_pointmap_follows_the_image_through_crop_and_distortion(tmp_path: Path) -> None:
    """A pointmap that holds the photograph's own colours becomes the network's input."""
    rng = np.random.default_rng(0)
    image = np.kron(rng.integers(0, 256, (4, 5, 3)), np.ones((30, 32, 1))).astype(np.uint8)
    K = np.array([[120.0, 0, 80], [0, 120, 60], [0, 0, 1]])
    camera = Camera("desk/images/a.jpg", 160, 120, K, np.eye(4), distortion=(-0.1, 0.02, 0, 0))
    path = pointmap_path(tmp_path, Path("desk/images/a.jpg"))
    assert path == tmp_path / "desk" / "a.npy"
    path.parent.mkdir()
    np.save(path, image / np.float32(255))
    found = load_pointmap(tmp_path, Path("desk/images/a.jpg"), camera, 64, 64).reshape(64, 64, 3)
    expected = load_view((image, camera), 64, 64).image.transpose(1, 2, 0)
    assert (np.abs(found - expected).max(axis=2) < 0.02).mean() > 0.7  # inside blocks of one colour


@pytest.mark.parametrize(
    ("content", "expected"),
    ((None, "is not there"), (b"no pointmap", "cannot be read"), (np.zeros((4, 3)), r"float64 \[4, 3\], expected")),
)
def test_a_bad_pointmap_is_named(content: object, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "desk" / "a.npy"
    path.parent.mkdir()
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    with pytest.raises(InputError, match=expected):
        check_pointmap(tmp_path, Path("desk/a.jpg"))


@pytest.mark.parametrize(
    ("changes", "expected"),
    (
        ({"pm_loss": 0.005, "part": "head", "init": "x.ckpt"}, "--pm-loss: trains depth"),
        ({"consistency": 1.0, "objective": "depth"}, "--consistency: needs Gaussians"),
        ({"pointmaps": "maps", "pm_loss": 0.005}, "--pointmaps: are those of captures"),
        ({"pm_loss": 0.005, "objective": "photometric", "data": ["a"]}, "--pm-loss: captures have no true points"),
        ({"aperture": 0.1}, "--lens-diameter: is that of captures"),
        ({"aperture": 0.1, "data": ["a"], "real_ratio": 0.0}, "--lens-diameter: is that of captures"),
    ),
)
def test_terms_without_effect_are_refused(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        network_config(replace(SETTINGS, **changes))  # type: ignore[arg-type]


def test_every_term_reaches_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradients of each term flow to depth, through the loss of a scene as a run computes it."""
    views = with_matches(generate_views, SampleSpec(11, 2, (1,), 64, 64))
    assert views.inverse_depth is not None
    capture = replace(views, inverse_depth=None, pointmap=exact_pointmap(views))
    for terms, given in (
        (OptionalTerms(pm_loss=0.005), views),
        (OptionalTerms(pm_loss=0.005), capture),
        (OptionalTerms(consistency=0.01), views),
        (OptionalTerms(aperture=0.05), capture),
    ):
        inverse = (0.9 * views.inverse_depth[:, None]).requires_grad_()
        gaussians = _gaussians_of(1 / inverse[:, 0], views)
        output = step.PhaseOutput(None, (), inverse, torch.zeros(1), gaussians, views.target_images)  # type: ignore[arg-type]
        step.rendering_loss(output, given, None, terms).backward()
        assert inverse.grad is not None and float(inverse.grad.abs().max()) > 0, terms


def _gaussians_of(depth: torch.Tensor, views) -> WorldGaussians:
    """A small opaque Gaussian at each pixel's point."""
    means = exact_pointmap(replace(views, inverse_depth=1 / depth))
    count = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    return WorldGaussians(
        means, torch.full((count, 3), 0.02), quats, torch.full((count,), 0.8), torch.zeros(count, 1, 3)
    )
