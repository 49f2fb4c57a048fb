"""Names of output files: endings that tell what a file holds, and the fixed names in a folder of outputs.

Endings of splat formats are the keys of `splats.io.FORMATS`; the layout of a COLMAP workspace is COLMAP's own
(`inference.colmap_workspace`).
"""

from collections.abc import Sequence
from pathlib import Path

DEPTH, ALPHA = "-depth", "-alpha"  # end a name before its suffix; colours alone have no ending
IMAGE, ARRAYS, VIDEO = ".png", ".npz", ".mp4"
SPLATS = ".ply"  # of `idesplat infer` without --out
CAMERAS_FILE = "cameras.json"  # what `idesplat cameras estimate` writes by default
ESTIMATED_CAMERAS = f".{CAMERAS_FILE}"  # ends the name of estimated cameras, beside the scene
DEPTH_FOLDER = DEPTH  # ends the name of the folder of depth maps, beside the scene
# Endings of point clouds and meshes. The longest ending counts: .points.ply is not .ply.
POINT_ENDINGS = (".points.ply", ".points.glb", ".obj", ".xyz")
MESH_ENDINGS = (".mesh.ply", ".mesh.glb", ".mesh.obj")
# Of an evaluation and of the demo.
RESULTS, SUMMARY = "results.json", "summary.json"


def beside(path: Path, suffix: str, ending: str) -> Path:
    """The file or folder beside one that ends in `suffix`, called like it but for the ending."""
    return path.with_name(path.name[: -len(suffix)] + ending)


def depth_map_files(folder: Path, stems: Sequence[str]) -> list[Path]:
    """The depth maps of views: an image, and the metric depth with its camera, for each."""
    return [folder / (stem + suffix) for stem in stems for suffix in (IMAGE, ARRAYS)]


def render_files(folder: Path, stems: Sequence[str], path_frames: int) -> list[Path]:
    """The renders of a reconstruction: one for each view, then the frames of a path through them."""
    names = [f"view-{stem}{IMAGE}" for stem in stems]
    names += [f"path-{index:03d}{IMAGE}" for index in range(path_frames)]
    return [folder / name for name in names]


def frame_names(frames: int) -> list[str]:
    """The frames of a path or an orbit, without suffix."""
    return [f"frame-{index:04d}" for index in range(frames)]


def kind_file(stem: Path, kind: str, suffix: str) -> Path:
    """A rendered image, video or array. stem: without suffix. kind: "", DEPTH or ALPHA."""
    return stem.with_name(stem.name + kind + suffix)


def strip_file(folder: Path, scene: str, target: str) -> Path:
    """A strip of an evaluation, of a target view of a scene."""
    return folder / f"{scene}-{target}{IMAGE}"
