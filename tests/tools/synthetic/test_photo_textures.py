"""Textures from images, and the scene kinds of training; reported scenes have neither."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from idesplat.runtime.errors import InputError
from idesplat.tools.synthetic.builder import SceneBuilder
from idesplat.tools.synthetic.layout import LAYOUTS, TRAINING_LAYOUTS
from idesplat.tools.synthetic.photo_textures import concatenate, photo_textures
from idesplat.tools.synthetic.sampler import TRAINING_SEEDS, VALIDATION_SEEDS
from idesplat.tools.synthetic.textures import PHOTO_KIND, SIZE, texture_bank
from idesplat.tools.training.data.samples import SampleSpec
from idesplat.tools.training.data.synthetic import generate_views


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red image with texture, one of another format, and three that are of no use."""
    folder = tmp_path_factory.mktemp("textures")
    noise = np.random.default_rng(0).integers(0, 256, (SIZE + 40, SIZE + 90, 3)).astype(np.uint8)
    red = noise * np.array([0, 0, 1], np.uint8)  # BGR
    (folder / "below").mkdir()
    cv2.imwrite(str(folder / "below" / "red.png"), red)
    cv2.imwrite(str(folder / "light.hdr"), noise.astype(np.float32) * 40)
    cv2.imwrite(str(folder / "small.png"), red[: SIZE - 1])
    cv2.imwrite(str(folder / "plain.jpg"), np.full((SIZE, SIZE, 3), 90, np.uint8))
    (folder / "broken.jpg").write_bytes(b"no image")
    return folder


def test_crops_of_images_are_textures(folder: Path) -> None:
    bank = photo_textures(folder)
    assert bank.kinds == (PHOTO_KIND,) * 2
    assert bank.texels.shape[1:] == texture_bank(1, 1).texels.shape[1:]
    finest = bank.texels[:, : SIZE * SIZE].reshape(2, SIZE, SIZE, 3)
    red = next(texture for texture in finest if texture[..., 2].max() == 0)
    assert red[..., 0].mean() == pytest.approx(127, abs=12) and red[..., 1].max() == 0  # RGB
    light = next(texture for texture in finest if texture[..., 2].max() > 0)
    assert light.max() == 255 and light.mean() > 127  # a display's gamma brightens the middle


def test_folder_without_texture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no image with texture"):
        photo_textures(tmp_path)


def test_materials_use_photos_if_there_are_any(folder: Path) -> None:
    builder = SceneBuilder(np.random.default_rng(1), concatenate(texture_bank(1, 13), photo_textures(folder)))
    for _ in range(50):
        builder.material("brick")
    photos = [texture in builder.photos for texture, *_ in builder.materials]
    assert len(builder.photos) == 2 and 0 < sum(photos) < len(photos)
    assert SceneBuilder(np.random.default_rng(1), texture_bank(1, 13)).photos == []


def test_training_scenes_change_and_reported_ones_do_not(folder: Path) -> None:
    training, reported = (SampleSpec(seeds[5], 2, (1,), 32, 32) for seeds in (TRAINING_SEEDS, VALIDATION_SEEDS))
    assert (generate_views(training).images != generate_views(training, folder).images).any()
    assert (generate_views(reported).images == generate_views(reported, folder).images).all()


@pytest.mark.parametrize("kind", range(len(TRAINING_LAYOUTS)))
def test_training_scene_kinds_are_well_formed(kind: int) -> None:
    layout = TRAINING_LAYOUTS[kind](np.random.default_rng(kind), texture_bank(1, 13))
    assert (layout.eye_bounds[0] <= layout.eye_bounds[1]).all() and (
        layout.focus_bounds[0] <= layout.focus_bounds[1]
    ).all()
    assert (layout.eye_bounds[:, 1] < 0).all()  # above the ground; y points down
    assert len(layout.scene.shapes) == len(layout.scene.materials) > 3
    assert layout.scene.materials.max() < len(layout.scene.textures)
    assert TRAINING_LAYOUTS[kind] not in LAYOUTS
