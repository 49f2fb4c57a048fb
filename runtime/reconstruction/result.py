"""The result of a reconstruction, and its output files."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.camera import Camera, named_from
from ..cameras.io import write_cameras
from ..geometry.trajectories import interpolate_extrinsics
from ..images.png import save_png
from ..inference.colmap_workspace import write_workspace
from ..inference.depth_format import DepthFormat
from ..inference.depth_maps import write_depth_maps
from ..inference.inputs import Inputs
from ..inference.metadata import ModelMetadata
from ..inference.model_files import ModelFiles
from ..inference.predictor import Prediction
from ..rendering.render import render_view
from ..splats.filtering import FilterOptions
from ..splats.gaussians import Gaussians
from ..splats.io import is_mesh, lost_offset, write_splats
from ..splats.mesh import MAX_DEPTH_JUMP, faces_from_depth
from ..splats.points import points_from_depth, write_mesh, write_point_cloud
from ..system.files import make_folder
from ..system.progress import progress
from ..viewer.report import write_report
from ..views.batch import ViewBatch
from ..views.depth_range import DepthRange
from ..views.exposure import Exposure
from .files import PATH_FRAMES, render_files, view_stems


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Depth and Gaussians, with the inputs and settings that they were computed from.

    prediction: the model's output, with filtered Gaussians. inputs: images, cameras and the chosen views.
    model: the model's files. depth_range: near and far in scene units, and their source.
    filters: the options. removed: number of Gaussians that each filter removed, by name.
    timings: seconds by step. notes: lines for the user. exposure: how the views were brought to a common exposure.
    psnr: of the refinement's views before each of its steps. refined_exposure: what the refinement found beside, from
    the views in their common exposure to the scene; None without refinement.
    """

    prediction: Prediction
    inputs: Inputs
    model: ModelFiles
    depth_range: DepthRange
    filters: FilterOptions
    removed: dict[str, int]
    timings: dict[str, float]
    notes: list[str]
    exposure: Exposure
    psnr: list[float] = field(default_factory=list)
    refined_exposure: Exposure | None = None

    @property
    def gaussians(self) -> Gaussians | None:
        """The Gaussians, in world coordinates minus `views.offset`; None for a model that predicts depth alone."""
        return self.prediction.gaussians

    @property
    def depth(self) -> np.ndarray:
        """Z-depth in scene units, float32 [views, height, width]."""
        return self.prediction.depth

    @property
    def cameras(self) -> list[Camera]:
        """The views' pinhole cameras at the size of the depth maps, poses relative to `views.offset`, [views]."""
        return self.prediction.cameras

    @property
    def views(self) -> ViewBatch:
        """The images used, as the network's input, with their full-size cameras."""
        return self.inputs.views

    @property
    def metadata(self) -> ModelMetadata:
        """The model's metadata."""
        return self.model.metadata

    def save(self, path: Path | str, max_depth_jump: float = MAX_DEPTH_JUMP) -> list[str]:
        """Write splats, points or a surface, by the file's suffix; returns a line for each loss of the format.

        max_depth_jump: for a surface, the relative difference of depth between neighbouring pixels across which no
        triangle is made. Raises InputError if the file cannot be written.
        """
        path = Path(path)
        if self.gaussians is not None and not is_mesh(path):
            return write_splats(path, self.gaussians, self.views.offset)
        points = points_from_depth(self.depth, self.views.images, self.views.extrinsics, self.views.intrinsics)
        if is_mesh(path):
            write_mesh(path, points, faces_from_depth(self.depth, max_depth_jump))
        else:
            write_point_cloud(path, points)
        return lost_offset(self.views.offset)

    def save_depth(self, folder: Path | str, depth_format: DepthFormat = DepthFormat.NPZ) -> list[Path]:
        """Write depth maps with their cameras (`depth_maps`), or a dense workspace of COLMAP; the paths written."""
        write = write_workspace if depth_format is DepthFormat.COLMAP else write_depth_maps
        return write(make_folder(Path(folder)), view_stems(self.views), self.prediction, self.views)

    def save_renders(self, folder: Path | str) -> list[Path]:
        """Render the input views and a smooth path from the first to the last, as .png; the paths written.

        Raises InputError if there are no Gaussians, or a file cannot be written.
        """
        gaussians, views = self.prediction.need_gaussians(), self.views
        height, width = self.depth.shape[1:]
        K = views.intrinsics.astype(np.float64) * np.array([width, height, 1.0])[:, None]  # [views, 3, 3]
        path = interpolate_extrinsics(views.extrinsics, PATH_FRAMES)
        poses = [*zip(views.extrinsics, K, strict=True), *((pose, K.mean(axis=0)) for pose in path)]
        files = render_files(make_folder(Path(folder)), views)
        for file, (pose, k) in progress(list(zip(files, poses, strict=True)), "rendering views"):
            save_png(file, render_view(gaussians, pose, k, width, height).rgb)
        return files

    def save_cameras(self, path: Path | str) -> None:
        """Write the cameras of all images: this project's JSON, or a transforms.json if it is called so.

        Estimated cameras name their images as seen from the file.
        """
        cameras = self.inputs.cameras
        write_cameras(Path(path), named_from(Path(path).parent, cameras) if self.inputs.estimated else cameras)

    def save_report(self, path: Path | str, summary: dict[str, Any] | None = None) -> None:
        """Write one .html with views, renders, depth, consistency and `summary` (`self.summary()` if not given)."""
        summary = summary or self.summary([Path(path)])
        write_report(Path(path), self.depth, self.prediction.need_gaussians(), self.views, summary)

    def summary(self, files: Sequence[Path] = (), seconds: dict[str, float] | None = None) -> dict[str, Any]:
        """A summary that JSON can hold. files: the written files. seconds: instead of `timings`."""
        percentiles = np.percentile(self.depth, (0, 50, 100)).tolist()
        return {
            "model": {"path": str(self.model.path), **asdict(self.metadata)},
            "cameras": self.inputs.source,
            "views": self.views.names,
            "notes": self.notes,
            "height": self.depth.shape[1],
            "width": self.depth.shape[2],
            "near": self.depth_range.near,
            "far": self.depth_range.far,
            "near_far_from": self.depth_range.source,
            "gaussians": 0 if self.gaussians is None else len(self.gaussians),
            "depth": dict(zip(("smallest", "median", "largest"), percentiles, strict=True)),
            "seconds": seconds or self.timings,
            "files": [str(path) for path in files],
            "offset": self.views.offset.tolist(),
            "exposure": self.exposure.summary(),
            "refinement": self._refinement(),
            "filtered": {"asked": asdict(self.filters), "left_out": self.removed},
        }

    def _refinement(self) -> dict[str, Any]:
        """The number of steps, the PSNR of the last ones, and the exposure of each view that was found beside."""
        last = [None if math.isnan(psnr) else psnr for psnr in self.psnr[-len(self.views.names) :]]
        found = {"steps": len(self.psnr), "psnr": last}
        if self.refined_exposure is None:
            return found
        return found | self.refined_exposure.as_lists()
