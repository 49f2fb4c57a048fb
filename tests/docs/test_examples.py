"""The examples of the deployment pages run, and their three languages agree."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
MODEL = Path(__file__).parents[2] / "runtime" / "inference" / "bundled" / "idesplat-lite.onnx"
VIEWS, SIDE = 2, 64
NUMBERS = [str(VIEWS), str(SIDE), str(SIDE)]
OUTPUTS = ("depth", "means", "scales", "quats", "opacities", "sh")


def run(*command: object, **options) -> str:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def tensors(scene, tmp_path_factory) -> Path:
    """The input tensors of two views, and in the same folder what the Python example computes from them."""
    folder = tmp_path_factory.mktemp("tensors")
    depth_range = ["--near", "1", "--far", "10", "--size", f"{SIDE}x{SIDE}", "--views", "0,2"]
    run(sys.executable, EXAMPLES / "write_tensors.py", scene, folder, *depth_range)
    printed = run(sys.executable, EXAMPLES / "infer_onnx.py", MODEL, folder, *NUMBERS)
    assert printed.splitlines()[0] == f"depth {VIEWS} {SIDE} {SIDE}"
    return folder


def read(folder: Path, name: str) -> np.ndarray:
    return np.fromfile(folder / f"{name}.f32", "<f4")


def copy_inputs(tensors: Path, folder: Path) -> Path:
    """A folder with the inputs alone."""
    names = [*(path for path in tensors.iterdir() if path.stem not in OUTPUTS)]
    for path in names:
        shutil.copy(path, folder)
    return folder


@pytest.mark.slow
def test_plain_onnxruntime_gives_what_the_library_gives(tensors: Path) -> None:
    import idesplat

    shapes = {"images": (VIEWS, 3, SIDE, SIDE), "extrinsics": (VIEWS, 4, 4), "intrinsics": (VIEWS, 3, 3)}
    images, extrinsics, intrinsics = (read(tensors, name).reshape(shape) for name, shape in shapes.items())
    predictor = idesplat.Predictor(MODEL)
    expected = predictor.predict_arrays(images, extrinsics, intrinsics, 1.0, 10.0)
    np.testing.assert_allclose(read(tensors, "depth"), expected.depth.ravel(), rtol=1e-3)
    np.testing.assert_allclose(read(tensors, "means"), expected.gaussians.means.ravel(), rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_library(scene: Path, tmp_path: Path) -> None:
    printed = run(sys.executable, EXAMPLES / "library.py", scene, tmp_path)
    assert "Gaussians" in printed
    assert (tmp_path / "scene.ply").stat().st_size > 1_000_000
    assert (tmp_path / "view.png").exists()


@pytest.mark.slow
def test_javascript(tensors: Path, tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    if not (EXAMPLES / "node_modules" / "onnxruntime-web").is_dir():
        pytest.skip("onnxruntime-web is not installed: npm install --prefix docs/examples")
    folder = copy_inputs(tensors, tmp_path)
    run(node, EXAMPLES / "infer.mjs", MODEL, folder, *NUMBERS)
    for name in OUTPUTS:  # quantiles, as verification has them: the quaternion of a nearly round Gaussian is arbitrary
        error = np.abs(read(folder, name) - read(tensors, name))
        assert np.percentile(error, 99.9) < 1e-3 * max(1, np.abs(read(tensors, name)).max()), name
    np.testing.assert_allclose(read(folder, "depth"), read(tensors, "depth"), rtol=1e-3)


def onnxruntime_release(folder: Path) -> tuple[Path, Path]:
    """Folders of headers and of the shared library: $ONNXRUNTIME_ROOT, or installed headers and the wheel's library."""
    if root := os.environ.get("ONNXRUNTIME_ROOT"):
        return Path(root) / "include", Path(root) / "lib"
    places = [Path("/usr/include"), Path("/usr/include/onnxruntime"), Path("/usr/local/include")]
    headers = [place for place in places if (place / "onnxruntime_cxx_api.h").exists()]
    if not headers:
        pytest.skip("no ONNX Runtime headers: set ONNXRUNTIME_ROOT to the folder of a release")
    libraries = sorted((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"))
    if not libraries:
        pytest.skip("no shared library of ONNX Runtime: set ONNXRUNTIME_ROOT to the folder of a release")
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / name).symlink_to(libraries[-1])
    return headers[0], folder


@pytest.mark.slow
def test_cpp(tensors: Path, tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler is installed")
    (tmp_path / "lib").mkdir()
    include, lib = onnxruntime_release(tmp_path / "lib")
    program = tmp_path / "infer"
    sources = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-isystem", include, EXAMPLES / "infer.cpp"]
    run(compiler, *sources, "-L", lib, "-lonnxruntime", f"-Wl,-rpath,{lib}", "-o", program)
    (tmp_path / "tensors").mkdir()
    folder = copy_inputs(tensors, tmp_path / "tensors")
    run(program, MODEL, folder, *NUMBERS)
    for name in OUTPUTS:
        np.testing.assert_allclose(read(folder, name), read(tensors, name), rtol=1e-3, atol=1e-3, err_msg=name)
    check_splats(folder)


def check_splats(folder: Path) -> None:
    """The example's .ply is the one that the library writes of the same Gaussians."""
    import idesplat

    scale, *origin = read(folder, "frame")
    values = {name: read(folder, name) for name in OUTPUTS[1:]}
    count = len(values["opacities"])
    expected = idesplat.Gaussians(
        means=values["means"].reshape(count, 3) / scale + np.array(origin, np.float32),
        scales=values["scales"].reshape(count, 3) / scale,
        quats=values["quats"].reshape(count, 4),
        opacities=values["opacities"],
        sh=values["sh"].reshape(count, -1, 3),
    )
    idesplat.write_splats(folder / "expected.ply", expected)
    ours, theirs = ((folder / name).read_bytes().split(b"end_header\n", 1) for name in ("expected.ply", "scene.ply"))
    assert theirs[0] == ours[0]
    np.testing.assert_allclose(np.frombuffer(theirs[1], "<f4"), np.frombuffer(ours[1], "<f4"), rtol=1e-5, atol=1e-6)
