"""The files that a reconstruction is saved as, known once its views are chosen."""

from pathlib import Path

from ..images.naming import name_files
from ..inference.colmap_workspace import workspace_files
from ..inference.depth_format import DepthFormat
from ..system import output_names
from ..views.batch import ViewBatch

PATH_FRAMES = 24  # rendered on a path from the first view to the last


def view_stems(views: ViewBatch) -> list[str]:
    """Unique names of the views, without suffix, derived from the images' names."""
    return name_files([camera.name for camera in views.cameras])


def depth_files(folder: Path, views: ViewBatch, depth_format: DepthFormat) -> list[Path]:
    """The files that `Reconstruction.save_depth` may write."""
    files = workspace_files if depth_format is DepthFormat.COLMAP else output_names.depth_map_files
    return files(folder, view_stems(views))


def render_files(folder: Path, views: ViewBatch) -> list[Path]:
    """The files that `Reconstruction.save_renders` writes: one for each view, then the frames of the path."""
    return output_names.render_files(folder, view_stems(views), PATH_FRAMES)
