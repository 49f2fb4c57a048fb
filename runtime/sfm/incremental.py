"""More than two images without cameras: our features and matches, COLMAP's mapper (pycolmap, extra `colmap`)."""

import importlib.util
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.camera import Camera
from ..cameras.formats.colmap import INSTALL, describe, observed_depths, to_camera
from ..errors import InputError
from ..system.files import scratch_folder
from ..system.progress import progress, working
from .features import match_features

if TYPE_CHECKING:
    import pycolmap

    from .estimate import UncalibratedImage

MODEL = "SIMPLE_RADIAL"
USUAL_FOCAL = 1.0  # in longer sides of the picture: where the search for the focal length starts
ALL_PAIRS = 20  # up to so many images each is matched with each, above with those next in order
NEXT = (1, 2, 3, 4, 6, 8, 12, 16)
FEWEST_MATCHES = 30
SEED = 0


def check_pycolmap(images: int) -> None:
    """Raise InputError where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            f"--cameras estimate: {images} images need pycolmap ({INSTALL}); without it, choose two with --frames"
        )


def run_incremental_sfm(images: "Sequence[UncalibratedImage]", refine_focal: bool) -> tuple[list[Camera], np.ndarray]:
    """The cameras of the images that fit together, in any frame and unit, and the depths of what they see.

    refine_focal: the images' focal lengths, where known, are no more than a start.
    Raises InputError where nothing fits together.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with scratch_folder() as folder:
        database_path = folder / "database.db"
        _fill(database_path, images)
        with working("placing images"):
            pycolmap.geometric_verification(database_path)
            models = pycolmap.incremental_mapping(database_path, folder, folder, _options(refine_focal))
    if not models:
        raise InputError(
            f"--cameras estimate: the {len(images)} images do not fit together; give more of them, that "
            "overlap and show texture, taken from places a step apart"
        )
    best = max(models.values(), key=lambda model: model.num_reg_images())
    path_of = {_name(index): image.path for index, image in enumerate(images)}
    cameras = [to_camera({**found, "name": str(path_of[found["name"]])}) for found in describe(best)]
    return cameras, np.concatenate([observed_depths(best, image) for image in best.images.values() if image.has_pose])


def _name(index: int) -> str:
    """What an image is called in the database: any two images have different names, in order."""
    return f"{index:06}"


def _fill(database_path: Path, images: "Sequence[UncalibratedImage]") -> None:
    """Write cameras, features and matches into a new database."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        camera_ids: dict[tuple[int, int, float | None], int] = {}  # images of equal size and focal length share one
        image_ids = []
        for index, image in enumerate(images):
            key = image.width, image.height, image.focal
            if key not in camera_ids:
                camera_ids[key] = _write_camera(database, image)
            record = pycolmap.Image(name=_name(index), camera_id=camera_ids[key])
            image_ids.append(database.write_image(record))
            database.write_keypoints(image_ids[-1], image.features.keypoints.astype(np.float32))
        for i, j in progress(_pairs(len(images)), "matching images"):
            matches = match_features(images[i].features, images[j].features)
            if len(matches) >= FEWEST_MATCHES:
                database.write_matches(image_ids[i], image_ids[j], matches.astype(np.uint32))


def _write_camera(database: "pycolmap.Database", image: "UncalibratedImage") -> int:
    import pycolmap

    width, height = image.width, image.height
    focal = image.focal or USUAL_FOCAL * max(width, height)
    camera = pycolmap.Camera(model=MODEL, width=width, height=height, params=[focal, width / 2, height / 2, 0.0])
    camera.has_prior_focal_length = image.focal is not None
    return int(database.write_camera(camera))


def _pairs(count: int) -> list[tuple[int, int]]:
    """Which images to match."""
    return [(i, j) for i, j in combinations(range(count), 2) if count <= ALL_PAIRS or j - i in NEXT]


def _options(refine_focal: bool) -> "pycolmap.IncrementalPipelineOptions":
    """The mapper's own, but for captures of few images taken close to each other."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.multiple_models = False
    options.extract_colors = False
    options.ba_refine_focal_length = refine_focal
    options.random_seed = SEED
    options.mapper.init_min_tri_angle = 4.0
    options.mapper.abs_pose_refine_focal_length = refine_focal
    return options
