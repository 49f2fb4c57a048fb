"""Refinement: it brings a scene closer to its images, depends on the seed alone, and stops when told to."""

from dataclasses import fields, replace

import numpy as np
import pytest
from idesplat.runtime.geometry.sh import SH_0, sh_basis
from idesplat.runtime.refinement.directions import view_directions
from idesplat.runtime.refinement.options import prediction_options
from idesplat.runtime.refinement.rasterizer import GradientRasterizer, Parameters
from idesplat.runtime.refinement.refine import Optimiser, PosedImage, RefinementOptions, refine
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.splats.gaussians import Gaussians
from scipy.spatial.transform import Rotation

SIZE = 32
K = np.array([[30.0, 0, SIZE / 2], [0, 30, SIZE / 2], [0, 0, 1]])


def scene(seed: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    count = 400
    return Gaussians(
        means=(rng.uniform(-1, 1, (count, 3)) * (2, 2, 0.5) + (0, 0, 4)).astype(np.float32),
        scales=np.full((count, 3), 0.12, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacities=np.full(count, 0.7, np.float32),
        sh=rng.normal(0, 0.6, (count, 1, 3)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def views() -> list[PosedImage]:
    """Images of a scene from three cameras side by side."""
    images = []
    for x in (-0.3, 0, 0.3):
        extrinsics = np.eye(4)
        extrinsics[0, 3] = x
        image = render_view(scene(0), extrinsics, K, SIZE, SIZE).rgb
        images.append(PosedImage(image, np.linalg.inv(extrinsics), K, np.ones((SIZE, SIZE), bool)))
    return images


@pytest.fixture(scope="module")
def wrong_colours() -> Gaussians:
    right = scene(0)
    noise = np.random.default_rng(1).normal(0, 0.5, right.sh.shape).astype(np.float32)
    return Gaussians(right.means, right.scales, right.quats, right.opacities, right.sh + noise)


def held_out_error(gaussians: Gaussians) -> float:
    extrinsics = np.eye(4)
    extrinsics[:2, 3] = 0.15, 0.1
    found, true = (render_view(each, extrinsics, K, SIZE, SIZE).rgb for each in (gaussians, scene(0)))
    return float(np.square(found - true).mean())


def test_a_view_that_was_not_given_comes_closer_too(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    refined = refine(wrong_colours, views, RefinementOptions(steps=150, lr_dc=2e-2, scale_factor=1, max_opacity=0.9))
    assert refined.steps == 150
    assert held_out_error(refined.gaussians) < 0.25 * held_out_error(wrong_colours)
    assert np.mean(refined.psnr[-3:]) > np.mean(refined.psnr[:3]) + 6


def test_the_result_depends_on_the_seed_alone(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    results = [refine(wrong_colours, views, RefinementOptions(steps=9, seed=seed)).gaussians for seed in (0, 0, 1)]
    np.testing.assert_array_equal(results[0].sh, results[1].sh)
    assert not np.array_equal(results[0].sh, results[2].sh)


def test_stops_when_told_to_and_leaves_its_input_alone(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    means = wrong_colours.means.copy()
    refined = refine(wrong_colours, views, RefinementOptions(steps=100), lambda step, psnr: step < 4)
    assert refined.steps == 5
    np.testing.assert_array_equal(wrong_colours.means, means)


def test_what_only_a_view_without_a_turn_shows_stays(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    """A wall hides all from the first view that has its turn; the other looks at the scene from past it."""
    wall = Gaussians(
        means=np.float32([[0, 0, 0.5], [0, 0, 0.52], [0, 0, 0.54]]),
        scales=np.tile(np.float32([1, 1, 0.01]), (3, 1)),
        quats=np.tile(np.float32([1, 0, 0, 0]), (3, 1)),
        opacities=np.full(3, 0.999, np.float32),
        sh=np.zeros((3, *wrong_colours.sh.shape[1:]), np.float32),
    )
    behind = replace(views[0], viewmat=np.eye(4))
    past = np.eye(4)
    past[2, 3] = -1
    before = replace(views[0], viewmat=past)
    both = Gaussians.concatenate([wall, wrong_colours])
    still = {f"lr_{name}": 0.0 for name in ("means", "scales", "quats", "opacities", "dc", "sh")}
    options = RefinementOptions(steps=1, max_opacity=0.999, scale_factor=1, **still)
    alone = len(refine(both, [behind], options).gaussians)
    assert alone < 0.2 * len(both)
    for seed in range(4):
        kept = refine(both, [behind, before], replace(options, seed=seed)).gaussians
        assert len(kept) > 0.6 * len(both)


def test_views_that_do_not_show_the_scene_have_no_psnr(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    away = replace(views[0], viewmat=np.diag([-1.0, 1, -1, 1]))
    refined = refine(wrong_colours, [away, *views], RefinementOptions(steps=4))
    assert np.isnan(refined.psnr).sum() == 1
    assert np.isfinite(refined.mean_psnr()).all()
    assert np.isnan(refine(wrong_colours, [away], RefinementOptions(steps=2)).mean_psnr()).all()


def test_pixels_without_weight_have_no_effect(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    ignored = [PosedImage(view.image, view.viewmat, view.K, np.zeros_like(view.valid)) for view in views]
    refined = refine(wrong_colours, ignored, RefinementOptions(steps=6))
    np.testing.assert_array_equal(refined.gaussians.sh, wrong_colours.sh)


def projected(viewmat: np.ndarray) -> np.ndarray:
    """The scene's means in an image, in pixels."""
    points = (scene(0).means @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return points[:, :2] / points[:, 2:]


def test_poses_come_closer_to_the_true_ones(views: list[PosedImage]) -> None:
    """One of three cameras is turned by half a degree, and the scene is right."""
    turned = Rotation.from_rotvec([0, np.radians(0.5), 0]).as_matrix()
    wrong = views[1].viewmat.copy()
    wrong[:3] = turned @ wrong[:3]
    given = [views[0], replace(views[1], viewmat=wrong), views[2]]
    options = RefinementOptions(steps=90, lr_poses=1e-3, lr_means=0, lr_scales=0, lr_quats=0, lr_dc=0, lr_opacities=0)
    refined = refine(scene(0), given, options)
    true, before, after = (projected(viewmat) for viewmat in (views[1].viewmat, wrong, refined.viewmats[1]))
    assert np.abs(after - true).mean() < 0.2 * np.abs(before - true).mean()


def test_poses_stay_as_given_unless_asked(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    refined = refine(wrong_colours, views, RefinementOptions(steps=3))
    np.testing.assert_array_equal(refined.viewmats, [view.viewmat for view in views])


def test_no_gaussian_is_stretched_over_what_the_scene_does_not_cover(views: list[PosedImage]) -> None:
    """Half of a scene, refined on images of the whole, covers no more than before."""
    whole = scene(0)
    half = whole.select(whole.means[:, 0] < 0)
    slow = RefinementOptions(steps=60, max_opacity=1 - 1e-6, lr_means=2e-4, lr_scales=1e-2)
    refined = refine(half, views, slow).gaussians
    before, after = (render_view(each, np.eye(4), K, SIZE, SIZE).alpha for each in (half, refined))
    assert after[:, 24:].max() < 0.2 and (after > 0.5).mean() < (before > 0.5).mean() + 0.03


def test_the_exposure_of_a_view_is_found(views: list[PosedImage]) -> None:
    """An image that is darker and bluer than the others changes its own exposure, not the scene's colours."""
    gain = np.float32([0.7, 0.8, 0.9])
    exposed = [replace(views[0], image=views[0].image * gain), *views[1:]]
    options = RefinementOptions(steps=300, scale_factor=1, max_opacity=0.9, lr_exposure=1e-2, lr_dc=1e-3)
    refined = refine(scene(0), exposed, options)
    colour = views[0].image.mean(axis=(0, 1))
    first, others = (refined.gains[part] * colour + refined.offsets[part] for part in (0, slice(1, None)))
    np.testing.assert_allclose(first / others.mean(axis=0), gain, atol=0.03)
    np.testing.assert_allclose(refined.gains.mean(axis=0), 1, atol=1e-6)
    fixed = refine(scene(0), exposed, replace(options, lr_exposure=0))
    assert np.mean(refined.psnr[-3:]) > np.mean(fixed.psnr[-3:]) + 6


def test_the_strongest_gaussians_are_kept(views: list[PosedImage]) -> None:
    """Half of the Gaussians lie hidden behind an opaque wall; these go first, and what is seen stays."""
    front = scene(0)
    opacities, scales = np.full(len(front), 0.99, np.float32), np.full((len(front), 3), 0.3, np.float32)
    wall = replace(front, opacities=opacities, scales=scales)
    hidden = replace(front, means=front.means + np.float32([0, 0, 6]))
    both = Gaussians(*(np.concatenate([getattr(part, f.name) for part in (hidden, wall)]) for f in fields(wall)))
    options = RefinementOptions(steps=10, max_gaussians=len(front), lr_scales=1e-2, lr_opacities=5e-2)
    refined = refine(both, views, options).gaussians
    assert 0 < len(refined) <= len(front)
    assert (refined.means[:, 2] < 6).mean() > 0.99


def test_opacities_decay_and_scales_grow_where_a_view_sees_them(views: list[PosedImage]) -> None:
    """By hand: at o = 0.5 the gradient of the opacity is o (1 - o) = 0.25, so 0.4 of it takes 0.1 from the logit 0."""
    seen = replace(scene(0), opacities=np.full(400, 0.5, np.float32))
    behind = replace(seen, means=-seen.means)
    fixed = {f"lr_{name}": 0.0 for name in ("means", "scales", "quats", "opacities", "dc", "sh")}
    options = RefinementOptions(steps=1, opacity_decay=0.4, scale_growth=0.05, **fixed)
    refined = refine(Gaussians.concatenate([seen, behind]), views, options).gaussians
    np.testing.assert_allclose(refined.opacities[400:], 0.5, atol=1e-6)
    np.testing.assert_allclose(refined.scales[400:], 0.12, rtol=1e-6)
    changed = np.abs(refined.opacities[:400] - 0.5) > 1e-6  # some lie outside of the one view that has its turn
    assert changed.mean() > 0.3
    np.testing.assert_allclose(refined.opacities[:400][changed], 1 / (1 + np.exp(0.1)), atol=1e-6)
    np.testing.assert_allclose(refined.scales[:400][changed], 0.12 * np.exp(0.05), rtol=1e-5)


@pytest.mark.parametrize(("steps", "growth"), [(40, 0.005), (200, 0.005), (920, 1 / 920)])
def test_scales_of_a_prediction_grow_by_e_at_most(steps: int, growth: float) -> None:
    assert prediction_options(steps).scale_growth == pytest.approx(growth)


def test_faint_gaussians_are_removed(views: list[PosedImage], monkeypatch: pytest.MonkeyPatch) -> None:
    """After 60 % of the steps, and at the end; none where all are faint."""
    at: list[int] = []
    prune = Optimiser.prune
    monkeypatch.setattr(Optimiser, "prune", lambda self, limit: (at.append(self.steps), prune(self, limit))[1])
    opacities = np.where(np.arange(400) % 4 == 0, 0.02, 0.7).astype(np.float32)
    options = RefinementOptions(steps=10, min_opacity=0.05, lr_opacities=0, lr_means=0)
    kept = refine(replace(scene(0), opacities=opacities), views, options).gaussians
    assert at == [6, 10]
    assert 250 < len(kept) <= 300
    assert kept.opacities.min() > 0.05
    all_faint = replace(scene(0), opacities=np.full(400, 0.02, np.float32))
    assert len(refine(all_faint, views, options).gaussians) > 300


def test_gaussians_that_no_view_sees_stay(views: list[PosedImage], wrong_colours: Gaussians) -> None:
    behind = scene(5)
    behind = Gaussians(-behind.means, behind.scales, behind.quats, behind.opacities, behind.sh)
    together = Gaussians(
        *(
            np.concatenate(pair)
            for pair in zip(
                (behind.means, behind.scales, behind.quats, behind.opacities, behind.sh),
                (
                    wrong_colours.means,
                    wrong_colours.scales,
                    wrong_colours.quats,
                    wrong_colours.opacities,
                    wrong_colours.sh,
                ),
                strict=True,
            )
        )
    )
    refined = refine(together, views, RefinementOptions(steps=6)).gaussians
    np.testing.assert_array_equal(refined.means[: len(behind)], behind.means)
    assert not np.array_equal(refined.means[len(behind) :], wrong_colours.means)


def test_an_empty_scene_renders_as_nothing() -> None:
    empty = Parameters(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))))
    view = PosedImage(np.zeros((8, 8, 3), np.float32), np.eye(4), K, np.ones((8, 8), bool))
    assert not GradientRasterizer(empty).forward(view.target).rgb.any()


def test_a_backdrop_keeps_its_opacity_where_others_start_with_less(views: list[PosedImage]) -> None:
    """So that no black shows through where nothing stands before it."""
    small = scene(0)
    backdrop = Gaussians(
        means=np.array([[0, 0, 8]], np.float32),
        scales=np.full((1, 3), 4.0, np.float32),
        quats=np.float32([[1, 0, 0, 0]]),
        opacities=np.float32([0.95]),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    options = RefinementOptions(steps=1, max_opacity=0.2, lr_opacities=0)
    refined = refine(Gaussians.concatenate([small, backdrop]), views, options).gaussians
    large = refined.scales[:, 0] > 1
    assert refined.opacities[large] == pytest.approx(0.95, abs=1e-3)
    assert refined.opacities[~large] == pytest.approx(0.2, abs=1e-3)


def with_degree_1(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians with SH of degree 1, of the same colour from everywhere."""
    return replace(gaussians, sh=np.pad(gaussians.sh, ((0, 0), (0, 3), (0, 0))))


def test_colours_that_follow_the_direction_turn_about_its_mean(
    views: list[PosedImage], wrong_colours: Gaussians
) -> None:
    """Where SH of degree 1 alone has a learning rate, a colour stays the same in the mean direction."""
    before = with_degree_1(wrong_colours)
    rates = {field.name: 0.0 for field in fields(RefinementOptions) if field.name.startswith("lr_")}
    after = refine(before, views, RefinementOptions(steps=9, **{**rates, "lr_sh_1": 0.03})).gaussians
    directions = view_directions(before.means, [view.target for view in views]).means
    some = directions.any(axis=1)
    basis = sh_basis(directions[some], 4)[:, :, None]
    assert len(after) == len(before)
    assert np.abs(after.sh[some, 1:]).max() > 0.1
    np.testing.assert_allclose((basis * after.sh[some]).sum(axis=1), SH_0 * before.sh[some, 0], atol=1e-5)
    np.testing.assert_array_equal(after.sh[~some, 1:], 0)


def test_two_views_tell_nothing_of_colours_that_follow_the_direction(
    views: list[PosedImage], wrong_colours: Gaussians
) -> None:
    after = refine(with_degree_1(wrong_colours), views[:2], RefinementOptions(steps=6)).gaussians
    assert after.sh[:, 0].std() > 0
    np.testing.assert_array_equal(after.sh[:, 1:], 0)


@pytest.mark.filterwarnings("error")
def test_a_scene_without_gaussians_stays_empty(views: list[PosedImage]) -> None:
    empty = with_degree_1(scene(0)).select(np.zeros(0, int))
    refined = refine(empty, views, RefinementOptions(steps=3))
    assert len(refined.gaussians) == 0 and np.isnan(refined.mean_psnr()[0])
