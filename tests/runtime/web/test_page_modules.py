"""The page's modules in headless Chromium, without a network: wrong cameras are refused, as by the commands."""

import json
import shutil
from pathlib import Path

import pytest
from idesplat.runtime.web.site import PAGE
from web_page import serving

pytestmark = [pytest.mark.browser, pytest.mark.slow]

MODEL = {"name": "none", "file": "none", "views": 2, "height": 64, "width": 96, "near": 1, "far": 10, "webgpu": False}
POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
LENS = {"w": 64, "h": 48, "fl_x": 60}
MANY = 600  # cameras
# The error of a reconstruction from files with these names.
RECONSTRUCT = """async ([names, cameras]) => {
  const { reconstruct } = await import("./idesplat.js");
  const files = names.map((name) => new File(["1"], name));
  return reconstruct(files, cameras, { provider: "wasm" }).catch((error) => `${error.name}: ${error.message}`);
}"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The page without its engine, and a description of a network that is not there."""
    folder = tmp_path_factory.mktemp("modules") / "page"
    shutil.copytree(PAGE, folder)
    (folder / "model.json").write_text(json.dumps(MODEL))
    return folder


@pytest.fixture
def page(browser, folder):
    """The page, without its service worker."""
    page = browser.new_context(service_workers="block").new_page()
    with serving(folder) as (address, _):
        page.goto(address)
        page.wait_for_function("document.getElementById('environment').textContent !== ''")
        yield page
    page.context.close()


def document(*names: str, **fields) -> dict:
    """A transforms.json of these images."""
    return {**LENS, **fields, "frames": [{"file_path": name, "transform_matrix": POSE} for name in names]}


@pytest.mark.parametrize(
    ("names", "cameras", "message"),
    [
        (["0.png", "1.png"], ["a/0.png", "b/0.png", "1.png"], "0.png: 2 cameras match it equally (a/0.png, b/0.png)"),
        (["0.png", "0.jpg"], ["0.png", "1.png"], "0.png and 0.jpg: both match the camera of 0.png"),
        (["0.png", "0.png"], ["0.png", "1.png"], "0.png and 0.png: both match the camera of 0.png"),
        (["r_0.5", "r_1.5"], ["r_0.6", "r_1.6"], "0 of 2 images are named by the cameras"),
    ],
)
def test_an_image_gets_the_camera_that_alone_names_it(page, names, cameras, message) -> None:
    assert page.evaluate(RECONSTRUCT, [names, document(*cameras)]).startswith(f"InputError: {message}")


def test_a_list_of_other_cameras_is_refused(page) -> None:
    answer = page.evaluate(RECONSTRUCT, [["0.png", "1.png"], [{"img_name": "0", "position": [0, 0, 0]}]])
    assert answer.startswith("InputError: cameras[0]: expected a camera as parseColmap gives it")


@pytest.mark.parametrize("text", ["[]", "null", '[{"img_name": "0"}]', '{"cameras": []}', '"frames"'])
def test_a_document_without_frames_is_refused(page, text) -> None:
    read = """(text) => import("./modules/dropped_files.js").then(({ readCameraFiles }) =>
      readCameraFiles([new File([text], "cameras.json")])).catch((error) => `${error.name}: ${error.message}`)"""
    assert page.evaluate(read, text).startswith("InputError: cameras.json: has no list of frames")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"k4": 0.01}, "k4 is 0.01, expected only k1, k2, p1, p2, k3 for a perspective lens"),
        ({"k6": 0.01}, "k6 is 0.01, expected only"),
        ({"p1": 0.01, "is_fisheye": True}, "p1 is 0.01, expected only k1, k2, k3, k4 for a fisheye lens"),
        ({"is_fisheye": 1}, "is_fisheye is 1, expected true or false"),
        ({"camera_model": None}, "camera_model is null, expected one of OPENCV"),
        ({"distortion_params": [0]}, "distortion_params is not read"),
        ({"fl_x": None, "camera_angle_x": 60}, "camera_angle_x is 60, expected radians between 0.001 and pi"),
        ({"fl_x": None, "camera_angle_x": 0.001}, "camera_angle_x is 0.001, expected radians"),
    ],
)
def test_lenses_that_the_commands_refuse(page, fields, message) -> None:
    wrong = {
        name: value for name, value in document("0.png", "1.png", **fields).items() if (name, value) != ("fl_x", None)
    }
    answer = page.evaluate(RECONSTRUCT, [["0.png", "1.png"], wrong])
    assert answer.startswith(f"InputError: transforms.json: 0.png: {message}")


def test_only_suffixes_of_images_are_left_out_of_names(page) -> None:
    names = {"a/r_0.5": "r_0.5", "a\\b.JPG": "b", "c.d.tiff": "c.d", ".png": ".png", "e.heic": "e", "f": "f"}
    stems = page.evaluate("(names) => import('./modules/cameras.js').then(({ stem }) => names.map(stem))", list(names))
    assert stems == list(names.values())


def test_coefficients_that_are_zero_are_no_distortion(page) -> None:
    parse = "(given) => import('./modules/cameras.js').then((cameras) => cameras.parseTransforms(given, []))"
    camera = page.evaluate(parse, document("0.png", k1=0, k4=0, k6=0))[0]
    assert (camera["distortion"], camera["fisheye"]) == (None, False)


def test_a_signal_that_is_aborted_already_starts_no_worker(page) -> None:
    call = """async () => {
      const { reconstruct } = await import("./idesplat.js");
      globalThis.Worker = class { constructor() { throw new Error("started"); } };
      return reconstruct([], null, { signal: AbortSignal.abort() }).catch((error) => `${error.name}: ${error.message}`);
    }"""
    assert page.evaluate(call) == "InputError: stopped"


def test_the_depth_of_many_parallel_cameras_is_guessed(page) -> None:
    """The guess is done when the first image is asked for."""
    call = """async (count) => {
      const { selectPair } = await import("./modules/selection.js");
      const pose = (index) => [1, 0, 0, index / count, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
      const camera = (_, index) => ({ width: 64, height: 48, K: [60, 60, 32, 24], pose: pose(index) });
      const featureImage = async () => { throw new Error("asked for an image"); };
      return selectPair(Array.from({ length: count }, camera), featureImage).catch((error) => error.message);
    }"""
    assert page.evaluate(call, MANY) == "asked for an image"
