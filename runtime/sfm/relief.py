"""The reversed relief of a reconstruction, near and far exchanged, which the mapper may take for the right one.

Cameras that see little depth, as from the air, see almost the same of a relief as others of its mirror image about a
plane across their view (Szeliski and Kang 1997, Shape ambiguities in structure from motion). A mapper that starts in
the wrong one stays there, with twice the reprojection error: bundle adjustment does not lead from one to the other.
"""

import logging
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.formats.colmap import registered_images

if TYPE_CHECKING:
    import pycolmap

LOG = logging.getLogger(__name__)

# Images that are adjusted to compare both; the mapper adds the others again. They see MIN_SHARED of the same points:
# more images turn too far for bundle adjustment to find the right relief from the other one.
IMAGES = 12
MIN_SHARED = 0.25
POINTS = 1000  # of them, those that most of these images see
MIN_POINTS = 50  # fewer do not tell which relief is right
ITERATIONS = 50  # of a bundle adjustment
# Median reprojection error of the mirror image before its adjustment, over the longer side of the image: what is seen
# from many sides has more, and no such ambiguity.
MAX_START_ERROR = 0.1
MAX_RATIO = 0.8  # of the adjusted median errors, from which on the reversed relief is the right one
MIRROR = np.diag([1.0, 1.0, -1.0])


def reversed_relief(model: "pycolmap.Reconstruction", refine_focal: bool) -> "pycolmap.Reconstruction | None":
    """Up to IMAGES images of the reconstruction with their relief reversed, if that fits them better; else None.

    refine_focal: adjust focal lengths, too.
    """
    import pycolmap

    found = pycolmap.Reconstruction(model)
    _reduce(found)
    if found.num_points3D() < MIN_POINTS:
        return None
    mirrored = pycolmap.Reconstruction(found)
    _reverse(mirrored)
    longest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    if not _error(mirrored) <= MAX_START_ERROR * longest:  # nor if it is not a number
        return None
    _adjust(found, refine_focal)
    _adjust(mirrored, refine_focal)
    errors = _error(found), _error(mirrored)
    LOG.info("median reprojection error %.2f px, with the relief reversed %.2f px", *errors)
    if not errors[1] < MAX_RATIO * errors[0]:
        return None
    mirrored.normalize()
    return mirrored


def _reduce(model: "pycolmap.Reconstruction") -> None:
    """Keep images spread over those that see what the one in the middle sees, and the points that most of them see."""
    images = registered_images(model)
    middle = _points(images[len(images) // 2])
    near = [image for image in images if len(middle & _points(image)) >= MIN_SHARED * len(middle)]
    places = np.unique(np.linspace(0, len(near) - 1, min(IMAGES, len(near))).round().astype(int))
    kept = {near[place].image_id for place in places}
    for image in images:
        if image.image_id not in kept:
            model.deregister_frame(image.frame_id)
    lengths = {identifier: point.track.length() for identifier, point in model.points3D.items()}
    for identifier in sorted(lengths, key=lambda identifier: -lengths[identifier])[POINTS:]:
        model.delete_point3D(identifier)


def _points(image: "pycolmap.Image") -> set[int]:
    """The points that an image sees."""
    return {point.point3D_id for point in image.get_observation_points2D()}


def _reverse(model: "pycolmap.Reconstruction") -> None:
    """Exchange near and far, about the middle depth of the image in the middle.

    A point at depth z goes along the ray of that image to z0^2 / z. The other cameras turn to the other side about the
    point at z0 on that image's axis, and keep their view of it.
    """
    import pycolmap

    images = registered_images(model)
    middle = images[len(images) // 2].cam_from_world()
    in_middle = np.stack([middle * point.xyz for point in model.points3D.values()])
    centre = float(np.median(in_middle[:, 2]))
    axis = np.array([0, 0, centre])
    for point, (x, y, z) in zip(model.points3D.values(), in_middle, strict=True):
        point.xyz = np.array([x, y, z]) * (centre / z) ** 2
    for image in images:
        from_middle = image.cam_from_world() * middle.inverse()
        rotation = MIRROR @ from_middle.rotation.matrix() @ MIRROR
        turned = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), from_middle * axis - rotation @ axis)
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, turned)


def _adjust(model: "pycolmap.Reconstruction", refine_focal: bool) -> None:
    """Bundle adjustment with a robust loss, first with the cameras' focal lengths as they are."""
    import pycolmap

    config = pycolmap.BundleAdjustmentConfig()
    for image in registered_images(model):
        config.add_image(image.image_id)
    for refine in (False, True) if refine_focal else (False,):
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = refine
        options.refine_extra_params = refine
        options.print_summary = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.solver_options.max_num_iterations = ITERATIONS
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _error(model: "pycolmap.Reconstruction") -> float:
    """The median over the points of their mean reprojection errors, in pixels."""
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()]))
