"""More than two photographs without cameras: our features and matches, COLMAP's mapper (pycolmap, extra `colmap`)."""

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

    from .estimate import Photograph

MODEL = "SIMPLE_RADIAL"
USUAL_FOCAL = 1.0  # in longer sides of the picture: where the search for the focal length starts
ALL_PAIRS = 20  # up to so many photographs each is matched with each, above with those next in order
NEXT = (1, 2, 3, 4, 6, 8, 12, 16)
FEWEST_MATCHES = 30
SEED = 0


def check_mapper(photographs: int) -> None:
    """Raise InputError where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            f"--cameras estimate: {photographs} photographs need pycolmap ({INSTALL}); "
            "without it, choose two with --frames"
        )


def place_photographs(photographs: "Sequence[Photograph]", refine_focal: bool) -> tuple[list[Camera], np.ndarray]:
    """The cameras of the photographs that fit together, in any frame and unit, and the depths of what they see.

    refine_focal: the photographs' focal lengths, where known, are no more than a start.
    Raises InputError where nothing fits together.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with scratch_folder() as folder:
        database_path = folder / "database.db"
        _fill(database_path, photographs)
        with working("placing photographs"):
            pycolmap.geometric_verification(database_path)
            models = pycolmap.incremental_mapping(database_path, folder, folder, _options(refine_focal))
    if not models:
        raise InputError(
            f"--cameras estimate: the {len(photographs)} photographs do not fit together; give more of them, that "
            "overlap and show texture, taken from places a step apart"
        )
    best = max(models.values(), key=lambda model: model.num_reg_images())
    path_of = {_name(index): photograph.path for index, photograph in enumerate(photographs)}
    cameras = [to_camera({**image, "name": str(path_of[image["name"]])}) for image in describe(best)]
    return cameras, np.concatenate([observed_depths(best, image) for image in best.images.values() if image.has_pose])


def _name(index: int) -> str:
    """What a photograph is called in the database: any two photographs have different names, in order."""
    return f"{index:06}"


def _fill(database_path: Path, photographs: "Sequence[Photograph]") -> None:
    """Write cameras, features and matches into a new database."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        camera_of: dict[tuple[int, int, float | None], int] = {}
        images = []
        for index, photograph in enumerate(photographs):
            kind = photograph.width, photograph.height, photograph.focal
            if kind not in camera_of:
                camera_of[kind] = _write_camera(database, photograph)
            image = pycolmap.Image(name=_name(index), camera_id=camera_of[kind])
            images.append(database.write_image(image))
            database.write_keypoints(images[-1], photograph.features.places.astype(np.float32))
        for i, j in progress(_pairs(len(photographs)), "matching photographs"):
            matches = match_features(photographs[i].features, photographs[j].features)
            if len(matches) >= FEWEST_MATCHES:
                database.write_matches(images[i], images[j], matches.astype(np.uint32))


def _write_camera(database: "pycolmap.Database", photograph: "Photograph") -> int:
    import pycolmap

    width, height = photograph.width, photograph.height
    focal = photograph.focal or USUAL_FOCAL * max(width, height)
    camera = pycolmap.Camera(model=MODEL, width=width, height=height, params=[focal, width / 2, height / 2, 0.0])
    camera.has_prior_focal_length = photograph.focal is not None
    return int(database.write_camera(camera))


def _pairs(count: int) -> list[tuple[int, int]]:
    """Which photographs to match."""
    return [(i, j) for i, j in combinations(range(count), 2) if count <= ALL_PAIRS or j - i in NEXT]


def _options(refine_focal: bool) -> "pycolmap.IncrementalPipelineOptions":
    """The mapper's own, but for captures of few photographs taken close to each other."""
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
