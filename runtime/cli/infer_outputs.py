"""The files that `idesplat infer` writes: checked before the work, written after it."""

import json
import shlex
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ..cameras.discovery import Found
from ..cameras.io import check_writable
from ..errors import InputError
from ..inference.depth_format import DepthFormat
from ..inference.inputs import Inputs
from ..inference.model_files import ModelFiles
from ..reconstruction.files import PATH_FRAMES, depth_files, render_files
from ..reconstruction.result import Reconstruction
from ..splats.filtering import FilterOptions
from ..splats.io import holds_splats, is_mesh, splat_suffix
from ..splats.mesh import MAX_DEPTH_JUMP
from ..splats.points import POINT_SUFFIXES
from ..system.output_names import DEPTH_FOLDER, ESTIMATED_CAMERAS, MESH_ENDINGS, beside
from ..system.outputs import outputs
from .input_files import camera_files, given_images, model_files, named_images
from .outputs import STANDARD_OUTPUT, write_json
from .reporting import note
from .terminal import say

# COLMAP's default of StereoFusion.min_num_pixels.
COLMAP_MIN_PIXELS = 5


@dataclass
class Targets:
    """The output files and folders, by option. found: the input images and the cameras' file, if there is one."""

    out: Path
    save_depth: Path | None
    depth_format: DepthFormat | None
    render: Path | None
    save_cameras: Path | None
    report: Path | None
    json_path: Path | None
    found: Found
    _written: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        splat_suffix(self.out)
        if self.found.cameras is None and self.save_cameras is None:
            self.save_cameras = self._beside(ESTIMATED_CAMERAS)

    def announce(self, model: Path) -> None:
        """Register inputs and outputs before the work; raises InputError if they conflict."""
        run = outputs()
        run.reads("the model", model_files(model))
        run.reads("an image", given_images(self.found.images))
        if self.found.cameras is not None:
            run.reads("the cameras", camera_files(self.found.cameras))
        run.writes("--out", [self.out])
        if self.json_path is not None and self.json_path != STANDARD_OUTPUT:
            run.writes("--json", [self.json_path])
        for option, path in {"--save-cameras": self.save_cameras, "--report": self.report}.items():
            if path is not None:
                run.writes(option, [path])
        for option, folder in {"--save-depth": self.save_depth, "--render": self.render}.items():
            if folder is not None:
                run.writes_into(option, folder)

    def check_model(self, model: ModelFiles, filters: FilterOptions, refine: str | None, max_gaussians: int) -> None:
        """Raise InputError, before the work, if the model cannot produce a requested output.

        For a model that predicts depth alone, .ply and .glb are written as points.
        """
        surface, gaussians = is_mesh(self.out), model.metadata.gaussians
        needs = [f"--out {self.out}"] * (holds_splats(self.out) and splat_suffix(self.out) not in POINT_SUFFIXES)
        needs += ["--render"] * (self.render is not None) + ["--report"] * (self.report is not None)
        if not surface:
            needs += [f"--{step.replace('_', '-')}" for step in filters.enabled]
        if needs and not gaussians:
            endings = ", ".join((*POINT_SUFFIXES, *MESH_ENDINGS))
            raise InputError(f"{needs[0]}: {model.path} predicts depth alone; write points or a surface ({endings})")
        if surface and set(filters.enabled) - {"max_depth_jump"}:
            raise InputError(
                f"--out {self.out}: of all filters a surface knows --max-depth-jump alone; leave out the rest"
            )
        if self.depth_format is not None and self.save_depth is None and gaussians:
            raise InputError(f"--depth-format {self.depth_format}: give --save-depth, the folder to write to")
        asked = ["--refine"] * (refine not in (None, "0")) + ["--max-gaussians"] * bool(max_gaussians)
        if asked and (surface or not gaussians):
            raise InputError(f"{asked[0]}: changes Gaussians, and {self.out} is made from depth; leave it out")
        if not gaussians and self.save_depth is None:  # depth maps are such a model's main output
            self.save_depth = self._beside(DEPTH_FOLDER)

    def announce_views(self, inputs: Inputs) -> None:
        """Register the files named after the chosen views; raises InputError as `announce`."""
        run = outputs()
        run.reads("an image", inputs.images)
        if self.save_cameras is not None:
            check_writable(self.save_cameras, inputs.cameras)
        if self.found.cameras is not None:
            run.reads("an image", named_images(self.found.cameras, inputs.cameras))
        if self.save_depth is not None:
            run.writes("--save-depth", depth_files(self.save_depth, inputs.views, self._depth_format()))
        if self.render is not None:
            run.writes("--render", render_files(self.render, inputs.views))

    def write(self, result: Reconstruction, filters: FilterOptions, started: float) -> dict[str, float]:
        """Write all outputs; returns the seconds by step. started: `time.perf_counter` at the command's start."""
        writing = time.perf_counter()
        for line in result.save(self.out, filters.max_depth_jump or MAX_DEPTH_JUMP):
            note(f"note: {line}")
        views, self._written = [], [self.out]
        if self.save_depth is not None:
            outputs().make_folder(self.save_depth)
            views += result.save_depth(self.save_depth, self._depth_format())
        if self.render is not None:
            outputs().make_folder(self.render)
            views += result.save_renders(self.render)
        if self.save_cameras is not None:
            result.save_cameras(self.save_cameras)
            self._written.append(self.save_cameras)
        now = time.perf_counter()
        seconds = result.timings | {"write": now - writing, "total": now - started}
        summary = result.summary([*self._written, *views], seconds)
        summary["filtered"]["asked"] = asdict(filters)
        if self.report is not None:
            result.save_report(self.report, summary)
            self._written.append(self.report)
            summary["files"].append(str(self.report))
        if self.json_path is not None:
            write_json(self.json_path, json.dumps(summary, indent=2))
            self._written += [self.json_path] * (self.json_path != STANDARD_OUTPUT)
        return seconds

    def tell_written(self, result: Reconstruction, seconds: dict[str, float]) -> None:
        """Print which files and folders were written."""
        for path in self._written:
            say(f"wrote {path}{self._described(result, seconds) if path == self.out else ''}")
        views = len(result.views.names)
        if self.save_depth is not None and self._depth_format() is DepthFormat.COLMAP:
            fuse = ["colmap", "stereo_fusion", "--workspace_path", str(self.save_depth)]
            fuse += ["--output_path", str(self.save_depth / "fused.ply")]
            if views < COLMAP_MIN_PIXELS:
                fuse += ["--StereoFusion.min_num_pixels", str(views)]
            say(f"wrote {self.save_depth}: {views} depth maps as a dense workspace of COLMAP")
            note("to fuse them into one point cloud:", "    " + shlex.join(fuse))
        elif self.save_depth is not None:
            say(f"wrote {self.save_depth}: {views} depth maps, as .png to look at and as .npz in the cameras' unit")
        if self.render is not None:
            say(f"wrote {self.render}: {views} views and {PATH_FRAMES} frames of a path through them, as .png")

    def cameras_to_show(self, camera_format: str | None) -> list[str]:
        """The options that pass the cameras of this run, given, found or estimated, to other commands."""
        form = ["--camera-format", camera_format] if camera_format and self.found.cameras else []
        return ["--cameras", str(self.found.cameras or self.save_cameras), *form]

    def _described(self, result: Reconstruction, seconds: dict[str, float]) -> str:
        """Number of Gaussians, file size and total time, as the end of a line."""
        splats = result.gaussians if holds_splats(self.out) else None
        count = "" if splats is None else f"{len(splats):,} Gaussians, "
        return f": {count}{self.out.stat().st_size / 1e6:.1f} MB, in {seconds['total']:.1f} s"

    def _depth_format(self) -> DepthFormat:
        return self.depth_format or DepthFormat.NPZ

    def _beside(self, ending: str) -> Path:
        """The output's path with another ending."""
        return beside(self.out, splat_suffix(self.out), ending)
