"""COLMAP sparse models, binary and text, with and without rigs and frames, read by pycolmap (extra `colmap`).

Conventions (https://colmap.github.io/format.html): OpenCV axes; pixel centres at half-integers, as ours; poses are
world-to-camera, and are inverted here. Images without a pose are skipped. The 3D points that an image observes give its
depth range.

pycolmap can allocate all memory, or hang, on a damaged binary model. So a child process with resource limits reads the
model: this module, run as a program, which prints the images as JSON.
"""

import importlib.util
import json
import math
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError, error_context, one_line
from ...geometry.depth_bounds import depth_bounds
from ...geometry.intrinsics import intrinsic_matrix
from ...geometry.rigid import invert_rigid
from ...system.files import check_regular, open_regular
from ..camera import Camera
from ..source import CameraSource

if TYPE_CHECKING:
    import pycolmap

DESCRIPTION = "a COLMAP model"
PARTS = ("cameras", "images", "points3D")
ALL_PARTS = (*PARTS, "frames", "rigs")
SUFFIXES = (".bin", ".txt")
# Where COLMAP, nerfstudio and 3DGS put models, relative to the folder of the scene.
MODEL_FOLDERS = ("", "sparse", "colmap/sparse")

# Parameters of the camera models, in the order of COLMAP's files.
FOCAL, FOCALS = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
PERSPECTIVE = {
    "SIMPLE_PINHOLE": FOCAL,
    "PINHOLE": FOCALS,
    "SIMPLE_RADIAL": (*FOCAL, "k1"),
    "RADIAL": (*FOCAL, "k1", "k2"),
    "OPENCV": (*FOCALS, "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (*FOCALS, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": (*FOCAL, "k1"),
    "RADIAL_FISHEYE": (*FOCAL, "k1", "k2"),
    "OPENCV_FISHEYE": (*FOCALS, "k1", "k2", "k3", "k4"),
}

DEPTHS_USED = 500  # points of an image that are sampled for its depth range, at least
COUNT_BYTES, SMALLEST_RECORD = 8, 8
# Limits of the child process. CPU time does not depend on other processes; the wall time only ends a child that waits.
CPU_SECONDS, CPU_SECONDS_PER_MB = 20, 2
WALL_TIME_FACTOR = 20
CPU_TIME_EXCEEDED = -getattr(signal, "SIGXCPU", 24)  # exit status
MEMORY, MEMORY_PER_BYTE = 4 << 30, 40  # bytes
NOT_FINISHED = "pycolmap did not finish reading this model; is it damaged?"
INSTALL = 'pip install "idesplat[colmap]"'


def detect(source: CameraSource) -> bool:
    """Whether a file is a part of a model, or a folder holds one, also in its usual subfolders."""
    if source.is_folder:
        return bool(models_in(source.path))
    return source.path.stem in ALL_PARTS and source.path.suffix in SUFFIXES


def input_files(path: Path) -> list[Path]:
    """All files of the models in a folder, or of the model that a file belongs to."""
    if not path.is_dir():
        if path.stem not in ALL_PARTS:
            return []
        path = path.parent
    return [file for model in models_in(path) for file in sorted(model.iterdir())]


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the model in a folder, in its usual subfolders, or beside one of its files; `images` are not used.

    Raises InputError, also where pycolmap is not installed.
    """
    models = models_in(path if path.is_dir() else path.parent)
    if not models:
        raise InputError(f"holds no COLMAP model, expected the files {', '.join(PARTS)} (.bin or .txt)")
    if len(models) > 1:
        raise InputError(f"holds {len(models)} COLMAP models; give one of them, such as {models[0]}")
    cameras = []
    for image in _read_in_child_process(models[0]):
        with error_context(image["name"]):
            cameras.append(to_camera(image))
    return cameras


def models_in(folder: Path) -> list[Path]:
    """The folder if it holds a model, or else the models in its usual subfolders."""
    for subfolder in MODEL_FOLDERS:
        parent = folder / subfolder
        numbered = sorted(parent.glob("[0-9]*")) if parent.is_dir() else []
        found = [candidate for candidate in (parent, *numbered) if _is_model(candidate)]
        if found:
            return found[:1] if found[0] == parent else found
    return []


def _is_model(folder: Path) -> bool:
    return any(all((folder / (part + suffix)).is_file() for part in PARTS) for suffix in SUFFIXES)


def _read_in_child_process(model: Path) -> list[dict[str, Any]]:
    """The result of `describe` in a child process with resource limits."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(f"is a COLMAP model, for which pycolmap is needed; {INSTALL}")
    files = [file for file in model.iterdir() if file.suffix in SUFFIXES]
    for file in files:
        check_regular(file)
    _check_counts(files)
    size = sum(file.stat().st_size for file in files)
    seconds = math.ceil(CPU_SECONDS + CPU_SECONDS_PER_MB * size / 1e6)
    limits = str(MEMORY + MEMORY_PER_BYTE * size), str(seconds)
    # -P keeps Python from importing modules from the current folder.
    command = [sys.executable, "-P", "-m", __name__, str(model.absolute()), *limits]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=WALL_TIME_FACTOR * seconds
        )
    except subprocess.TimeoutExpired:
        raise InputError(NOT_FINISHED) from None
    if done.returncode == CPU_TIME_EXCEEDED:
        raise InputError(NOT_FINISHED)
    if done.returncode != 0:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise InputError(f"pycolmap cannot read this model ({reason[0]}); is it damaged?")
    images: list[dict[str, Any]] = json.loads(done.stdout)
    if not images:
        raise InputError("holds no registered image, expected images with poses; is the reconstruction complete?")
    return images


def _check_counts(files: Sequence[Path]) -> None:
    """Raise InputError for a binary file whose first number, the record count, exceeds what its size allows."""
    for file in files:
        if file.suffix == ".bin" and file.stem in ALL_PARTS:
            with open_regular(file) as opened:
                count = int.from_bytes(opened.read(COUNT_BYTES), "little")
            if count * SMALLEST_RECORD > file.stat().st_size:
                raise InputError(
                    f"{file.name} declares {count} records, more than its size allows: truncated or damaged"
                )


def to_camera(image: dict[str, Any]) -> Camera:
    """The camera of an image from `describe`. Raises InputError for an unsupported camera model."""
    model = image["model"]
    fields = PERSPECTIVE.get(model) or FISHEYE.get(model)
    if fields is None:
        known = ", ".join([*PERSPECTIVE, *FISHEYE])
        raise InputError(f"camera model {model}, expected one of {known}; run COLMAP's image_undistorter first")
    values = dict(zip(fields, image["parameters"], strict=True))
    focal = values.get("f", 0.0)
    K = intrinsic_matrix(values.get("fx", focal), values.get("fy", focal), values["cx"], values["cy"])
    extrinsics = invert_rigid(np.array([*image["cam_from_world"], [0, 0, 0, 1]]))
    fisheye = model in FISHEYE
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    count = 8 if "k3" in values and not fisheye else 4
    distortion = tuple(values.get(field, 0.0) for field in order[:count])
    return Camera(
        image["name"],
        image["width"],
        image["height"],
        K,
        extrinsics,
        distortion if fisheye or any(distortion) else None,
        fisheye,
        tuple(image["depth_range"]) if image["depth_range"] else None,
    )


# ---- a model in memory, as plain values


def describe(reconstruction: "pycolmap.Reconstruction") -> list[dict[str, Any]]:
    """The registered images of a model, sorted by name, as JSON values for `to_camera`."""
    found = []
    for image in registered_images(reconstruction):
        camera = reconstruction.camera(image.camera_id)
        found.append(
            {
                "name": image.name,
                "model": camera.model_name,
                "width": camera.width,
                "height": camera.height,
                "parameters": camera.params.tolist(),
                "cam_from_world": image.cam_from_world().matrix().tolist(),  # [3, 4]
                "depth_range": depth_bounds(observed_depths(reconstruction, image)),
            }
        )
    return found


def registered_images(reconstruction: "pycolmap.Reconstruction") -> "list[pycolmap.Image]":
    """The images of a model that have a pose, sorted by name."""
    return sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)


def observed_depths(reconstruction: "pycolmap.Reconstruction", image: "pycolmap.Image") -> np.ndarray:
    """Depths of the 3D points that an image observes, [points]; subsampled to between 500 and 1000 points."""
    observed = image.get_observation_point2D_idxs()
    observed = observed[:: max(1, len(observed) // DEPTHS_USED)]
    points = np.array([reconstruction.point3D(image.point2D(index).point3D_id).xyz for index in observed]).reshape(
        -1, 3
    )
    matrix = image.cam_from_world().matrix()  # [3, 4]
    return points @ matrix[2, :3] + matrix[2, 3]


def _limit_resources(memory: int, seconds: int) -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))


if __name__ == "__main__":
    _limit_resources(int(sys.argv[2]), int(sys.argv[3]))
    try:
        import pycolmap

        print(json.dumps(describe(pycolmap.Reconstruction(sys.argv[1]))))
    except Exception as error:  # pycolmap raises many types for damaged models
        sys.exit(one_line(error))
