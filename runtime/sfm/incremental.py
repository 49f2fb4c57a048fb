"""Incremental structure from motion for more than two images: own features and matches, COLMAP's mapper (pycolmap)."""

import importlib.util
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.camera import Camera
from ..cameras.formats.colmap import INSTALL, describe, observed_depths, registered_images, to_camera
from ..errors import InputError
from ..system.files import make_folder, scratch_folder
from ..system.progress import progress, working
from .features import match_features
from .relief import reversed_relief

if TYPE_CHECKING:
    import pycolmap

    from .estimate import UncalibratedImage

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Start:
    """How the mapper starts. held: focal lengths are not refined. focal: of those unknown, in longer image sides."""

    held: bool = False
    focal: float = 1.0


CAMERA_MODEL = "SIMPLE_RADIAL"
# Where focal lengths are unknown, the mapper starts from one and refines it. From a wrong one it may register two
# images or none; then it starts again from the next, and the last, a usual one, is held.
UNKNOWN_STARTS = (Start(focal=1.0), Start(focal=0.75), Start(focal=1.5), Start(focal=0.8, held=True))
# Few images do not determine a focal length as well as EXIF data tell it: of up to so many it is held at first.
MAX_HELD = 6
# A start is good if more than this share of the images is registered, or so many.
GOOD_SHARE, GOOD_COUNT = 0.75, 10
# A registered image counts if it sees so many points, with a focal length between these, in longer image sides.
MIN_IMAGE_POINTS = 20
MIN_FOCAL, MAX_FOCAL = 0.35, 3.5
MAX_EXHAUSTIVE = 20  # images that are matched exhaustively; more are matched with these next ones in order
SEQUENTIAL_OFFSETS = (1, 2, 3, 4, 6, 8, 12, 16)
MIN_MATCHES = 30
SEED = 0


def check_pycolmap(images: int) -> None:
    """Raise InputError where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            f"--cameras estimate: {images} images need pycolmap ({INSTALL}); without it, choose two with --select"
        )


def run_incremental_sfm(images: "Sequence[UncalibratedImage]", refine_focal: bool) -> tuple[list[Camera], np.ndarray]:
    """The cameras of the registered images, in an arbitrary world frame and unit, and the depths of their points.

    refine_focal: refine known focal lengths, too: at first only of more than MAX_HELD images.
    Raises InputError if no reconstruction is found.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    with scratch_folder() as folder:
        database_path = folder / "database.db"
        _fill(database_path, images)
        with working("registering images"):
            _verify(database_path)
            best = _reconstruct(database_path, folder, len(images), _starts(images, refine_focal))
    if best is None:
        raise InputError(
            f"--cameras estimate: none of the {len(images)} images could be registered; give more images that overlap, "
            "show texture, and are taken a step apart"
        )
    path_of = {_name(index): image.path for index, image in enumerate(images)}
    cameras = [to_camera({**found, "name": str(path_of[found["name"]])}) for found in describe(best)]
    depths = [observed_depths(best, image) for image in registered_images(best)]
    return cameras, _checked(np.concatenate([np.zeros(0), *depths]), len(cameras))


def _starts(images: "Sequence[UncalibratedImage]", refine_focal: bool) -> Sequence[Start]:
    """The ways to start, of which the first good one is taken."""
    if any(image.focal is None for image in images):
        return UNKNOWN_STARTS
    if not refine_focal:
        return [Start(held=True)]
    few = len(images) <= MAX_HELD
    return [Start(held=few), Start(held=not few)]


def _reconstruct(
    database_path: Path, folder: Path, count: int, starts: Sequence[Start]
) -> "pycolmap.Reconstruction | None":
    """The best reconstruction of `count` images from these starts, up to the first good one."""
    best = None
    for start in starts:
        _set_unknown_focals(database_path, start.focal)
        best = max(best, _map_right_relief(database_path, folder, not start.held), key=_usable)
        registered, points = _usable(best)
        LOG.info("%s: %d images and %d points at best", start, registered, points)
        if registered > GOOD_SHARE * count or registered >= GOOD_COUNT:
            break
    return best


def _usable(model: "pycolmap.Reconstruction | None") -> tuple[int, int]:
    """The number of images that count, and of points, of a reconstruction."""
    if model is None:
        return 0, 0
    count = 0
    for image in registered_images(model):
        camera = model.cameras[image.camera_id]
        focal = camera.focal_length / max(camera.width, camera.height)
        count += image.num_points3D >= MIN_IMAGE_POINTS and MIN_FOCAL < focal < MAX_FOCAL
    return count, model.num_points3D()


def _map_right_relief(database_path: Path, folder: Path, refine_focal: bool) -> "pycolmap.Reconstruction | None":
    """What the mapper makes, or makes from the reversed relief if that fits better; None if it makes nothing."""
    found = _map(database_path, folder, refine_focal)
    other = None if found is None else reversed_relief(found, refine_focal)
    return found if other is None else _map(database_path, folder, refine_focal, other)


def _map(
    database_path: Path, folder: Path, refine_focal: bool, start: "pycolmap.Reconstruction | None" = None
) -> "pycolmap.Reconstruction | None":
    """The reconstruction of most images that the mapper makes, or `start` or None if it makes none.

    folder: gets what it writes. start: a reconstruction that it adds the other images and points to.
    """
    import pycolmap

    given: Path | str = ""
    if start is not None:
        given = make_folder(folder / "start")
        start.write(given)
    models = pycolmap.incremental_mapping(database_path, folder, folder, _options(refine_focal), given)
    LOG.info("COLMAP's mapper made %d models", len(models))
    return max(models.values(), key=lambda model: model.num_reg_images(), default=start)


def _checked(depths: np.ndarray, registered: int) -> np.ndarray:
    """The depths [points], whose median becomes the unit; raises InputError if it cannot."""
    if len(depths) == 0 or not 0 < np.median(depths) < np.inf:
        raise InputError(
            f"--cameras estimate: {registered} images were registered, but no points in front of them found, whose "
            "depth would tell the scale; give more images that overlap, show texture, and are taken a step apart"
        )
    return depths


def _name(index: int) -> str:
    """The name of an image in the database: unique, and sorted as the images are."""
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
            if len(matches) >= MIN_MATCHES:
                database.write_matches(image_ids[i], image_ids[j], matches.astype(np.uint32))


def _write_camera(database: "pycolmap.Database", image: "UncalibratedImage") -> int:
    import pycolmap

    width, height = image.width, image.height
    focal = image.focal or max(width, height)  # each start sets those that are unknown
    camera = pycolmap.Camera(model=CAMERA_MODEL, width=width, height=height, params=[focal, width / 2, height / 2, 0.0])
    camera.has_prior_focal_length = image.focal is not None
    return int(database.write_camera(camera))


def _pairs(count: int) -> list[tuple[int, int]]:
    """The pairs of images to match."""
    return [(i, j) for i, j in combinations(range(count), 2) if count <= MAX_EXHAUSTIVE or j - i in SEQUENTIAL_OFFSETS]


def _set_unknown_focals(database_path: Path, sides: float) -> None:
    """Set the focal lengths that are not known, in longer image sides."""
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        for camera in database.read_all_cameras():
            if not camera.has_prior_focal_length:
                camera.focal_length = sides * max(camera.width, camera.height)
                database.update_camera(camera)


def _verify(database_path: Path) -> None:
    """Find the matches that fit a relative pose, the same ones in each run."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    pycolmap.geometric_verification(database_path, two_view_geometry_options=options)


def _options(refine_focal: bool) -> "pycolmap.IncrementalPipelineOptions":
    """The defaults, relaxed for captures of few images with short baselines."""
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
