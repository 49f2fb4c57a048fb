"""The page in headless Chromium: from chosen files to a downloaded splat, and wrong files."""

import base64
import io
import json
import shlex
import struct
import threading
import zlib
from collections.abc import Callable
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_cases import colmap_model, known
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.cli.infer import main as infer
from idesplat.runtime.cli.web import main as web
from idesplat.runtime.geometry.intrinsics import intrinsic_matrix
from idesplat.runtime.images.exif import EXIF_DIRECTORY, FOCAL_LENGTH_35MM
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.sfm.estimate import estimate_cameras
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_splats
from idesplat.runtime.web import third_party
from PIL import Image
from shared_fixtures import build_once
from web_page import StaticHost, check_equal, download, drop, finished, opened, reconstruct, serving

pytestmark = pytest.mark.slow

SIZE = "64x96"
# Between the command's estimate and the page's, in units of the median depth: the page matches smaller images.
MAX_ROTATION_DEG, MAX_SHIFT = 0.5, 0.02
FOCAL_MM = 29  # of these images, rounded
# The viewer sorts the splats in the background.
TRIES, BETWEEN_MS = 60, 500
WAIT_S = 60


@pytest.fixture(scope="module")
def captured(tmp_path_factory) -> Path:
    """Three images of a synthetic room, 192 x 256, whose cameras have lens distortion."""
    from idesplat.tools.synthetic.make_scene import make_scene

    def make(folder: Path) -> None:
        make_scene(folder, seed=5, views=3, height=192, width=256)
        cameras = json.loads((folder / "transforms.json").read_text())
        for frame in cameras["frames"]:
            frame |= {"k1": -0.06, "k2": 0.01, "p1": 0.001, "p2": -0.002}
        (folder / "transforms.json").write_text(json.dumps(cameras))

    return build_once(tmp_path_factory, "captured", make)


@pytest.fixture(scope="module")
def site(exported, tmp_path_factory) -> Path:
    """The page with the small network."""
    if not third_party.VENDOR.is_dir():
        pytest.skip("the npm files of the page are not there; make web")
    folder = tmp_path_factory.mktemp("site")
    assert run_command(web, folder, "--model", exported[0], "--size", SIZE) == 0
    return folder


@pytest.fixture(scope="module")
def expected(captured, exported, tmp_path_factory) -> Gaussians:
    """The splats of the command."""
    out = tmp_path_factory.mktemp("native") / "scene.ply"
    given = ("-i", captured / "images", "-c", captured / "transforms.json", "--model", exported[0])
    assert run_command(infer, *given, "--quality", "fast", "--size", SIZE, "-o", out) == 0
    return read_splats(out)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> list[Path]:
    """Two images of a synthetic room, 480 x 640, as JPEG; the first tells its focal length."""
    from idesplat.tools.synthetic.make_scene import make_scene

    def make(folder: Path) -> None:
        make_scene(folder, seed=5, views=2, height=480, width=640)
        for number, path in enumerate(sorted((folder / "images").iterdir())):
            exif = Image.Exif()
            if number == 0:
                exif.get_ifd(EXIF_DIRECTORY)[FOCAL_LENGTH_35MM] = FOCAL_MM
            Image.open(path).save(folder / f"{path.stem}.jpg", quality=95, exif=exif)

    return sorted(build_once(tmp_path_factory, "two-rooms", make).glob("*.jpg"))


def files_of(scene: Path) -> list[Path]:
    return [*sorted((scene / "images").iterdir()), scene / "transforms.json"]


def test_wasm_from_files_to_splats_and_again_offline(browser, site, captured, expected, tmp_path):
    context = browser.new_context(viewport={"width": 400, "height": 500}, reduced_motion="reduce")
    page = context.new_page()
    complaints, requests = [], []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    context.on("request", lambda request: requests.append(request.url))
    with serving(site) as (address, server):
        opened(page, address)
        assert reconstruct(page, files_of(captured), "wasm") == ""
        found = download(page, "#ply", tmp_path)
        check_equal(found, expected)
        packed = download(page, "#spz", tmp_path)
        assert np.abs(packed.means - found.means).max() <= 2.0**-22 * max(1, np.abs(found.means).max())
        assert np.abs(packed.opacities - found.opacities).max() <= 1 / 255
        check_seen(page, found, read_cameras(captured / "transforms.json"))
        server.shutdown()
        server.server_close()
        page.reload()
        assert page.evaluate("crossOriginIsolated")
        assert reconstruct(page, files_of(captured), "wasm") == ""
        check_equal(download(page, "#ply", tmp_path), expected)
    context.close()
    assert complaints == []
    assert {url for url in requests if not url.startswith((address, "blob:", "data:"))} == set()


def check_seen(page, gaussians: Gaussians, cameras: list[Camera]) -> None:
    """The canvas shows what the rasteriser renders from the first view; a key turns the scene, a button turns it back.

    The two images differ by less than the rasteriser's and the same moved by one pixel.
    """
    name = page.inner_text("#depth figcaption >> nth=0")
    camera = next(camera for camera in cameras if camera.name == name)
    height, width = canvas(page).shape[:2]
    # The view fits the canvas, in whose middle the optical axis is.
    tangent = max(camera.height / camera.K[1, 1] / 2, camera.width / camera.K[0, 0] / 2 / (width / height))
    focal = height / 2 / tangent
    K = intrinsic_matrix(focal, focal, width / 2, height / 2)
    rendered = np.clip(render_view(gaussians, camera.extrinsics, K, width, height).rgb, 0, 1)
    moved = max(psnr(rendered[1:], rendered[:-1]), psnr(rendered[:, 1:], rendered[:, :-1]))
    assert becomes(page, lambda image: psnr(image, rendered) > moved)
    page.focus("#view")
    page.keyboard.press("ArrowRight")
    assert becomes(page, lambda image: psnr(image, rendered) < moved)
    page.focus("#reset")
    page.keyboard.press("Enter")
    assert becomes(page, lambda image: psnr(image, rendered) > moved)


def becomes(page, condition: Callable[[np.ndarray], bool]) -> bool:
    """Whether the scene that the page shows meets a condition, now or soon."""
    for _ in range(TRIES):
        if condition(canvas(page)):
            return True
        page.wait_for_timeout(BETWEEN_MS)
    return False


def canvas(page) -> np.ndarray:
    """The scene as the page shows it, [height, width, 3], 0 to 1."""
    encoded = page.evaluate("document.getElementById('view').toDataURL()").partition(",")[2]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"), np.float32) / 255


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_the_printed_command_makes_the_same_page(exported, tmp_path, capsys):
    chosen = ("--model", str(exported[0]), "--size", SIZE)
    assert run_command(web, tmp_path / "my page", *chosen) == 0
    printed = capsys.readouterr().out.partition("here: ")[2]
    assert shlex.split(printed) == ["idesplat", "web", str(tmp_path / "my page"), *chosen, "--serve"]


def test_webgpu_is_refused_for_a_graph_that_was_not_exported_for_it(browser, site, captured):
    """There it would be wrong without an error."""
    page = browser.new_page()
    with serving(site) as (address, _):
        opened(page, address)
        page.set_input_files("#files", files_of(captured))
        call = "cameras => import('./idesplat.js').then(({ reconstruct }) => reconstruct(files.files, cameras, "
        call += "{ provider: 'webgpu' })).catch((error) => error.message)"
        answer = page.evaluate(call, json.loads((captured / "transforms.json").read_text()))
        page.wait_for_function("document.querySelector('#provider').value === 'wasm'")
    page.close()
    assert answer == "the graph of this page was not exported for WebGPU; choose WebAssembly"


def on_page(page, expression: str, argument=None):
    """What an expression of the page's module gives; the message where it throws."""
    call = f"(given) => import('./idesplat.js').then((idesplat) => {expression}).catch((error) => error.message)"
    return page.evaluate(call, argument)


def test_colmap_cameras_are_the_commands(browser, site, tmp_path):
    colmap_model(known(["b/0.jpg", "c.jpg"]), "OPENCV", (510, 500, 301, 251, 0.1, 0.02, 0.001, -0.002)).write_text(
        tmp_path
    )
    expected = {camera.name: camera for camera in read_cameras(tmp_path)}
    texts = [(tmp_path / name).read_text() for name in ("cameras.txt", "images.txt")]
    page = browser.new_page()
    with serving(site) as (address, _):
        opened(page, address)
        found = on_page(page, "idesplat.parseColmap(...given)", texts)
        of_one_file = page.evaluate(
            "(names) => import('./modules/dropped_files.js').then(({ readCameraFiles }) => readCameraFiles("
            "names.map((name) => new File(['1'], name)))).catch((error) => error.message)",
            ["images.txt"],
        )
        wrong = on_page(page, "idesplat.parseColmap(...given)", [texts[0].replace(" OPENCV ", " FOV "), texts[1]])
    page.close()
    assert sorted(entry["name"] for entry in found) == sorted(expected)
    for entry in found:
        camera = expected[entry["name"]]
        np.testing.assert_allclose(np.reshape(entry["pose"], (4, 4)), camera.extrinsics, atol=1e-9)
        np.testing.assert_allclose(entry["K"], [*np.diag(camera.K)[:2], *camera.K[:2, 2]])
        np.testing.assert_allclose(entry["distortion"], [*camera.distortion, 0][:5])
        assert (entry["width"], entry["height"], entry["fisheye"]) == (camera.width, camera.height, False)
    assert of_one_file == "images.txt: add cameras.txt, too"
    assert "has the model FOV, expected SIMPLE_PINHOLE, PINHOLE" in wrong


# The cameras of the chosen files, by the modules that the worker of the page calls.
ESTIMATED = """async (focal) => {
    const { estimateCameras } = await import("./modules/estimation.js");
    const { readHeader } = await import("./modules/image_files.js");
    const files = [...document.querySelector("#files").files];
    const focals = (await Promise.all(files.map(readHeader))).map((header) => header.focal ?? focal);
    const views = await estimateCameras(files, focals, () => {}, []);
    return views.map(({ file, camera }) => ({ name: file.name, pose: camera.pose }));
}"""


def test_images_alone_are_dropped_and_get_the_commands_cameras(browser, site, rooms, tmp_path):
    """One image tells its focal length in EXIF data, for the other the slider does."""
    names = [path.name for path in rooms]
    page = browser.new_page()
    with serving(site) as (address, _):
        opened(page, address)
        drop(page, rooms)
        page.wait_for_selector("#chosen li >> nth=1")
        page.focus("#focal")
        page.evaluate(f"document.activeElement.value = {FOCAL_MM - 1}")
        page.keyboard.press("ArrowRight")
        assert page.inner_text("#focal-value") == f"{FOCAL_MM} mm"
        page.select_option("#provider", "wasm")
        page.focus("#start")
        page.keyboard.press("Enter")
        assert finished(page) == ""
        assert "the cameras were estimated" in page.inner_text("#notes")
        found = download(page, "#ply", tmp_path)
        page.set_input_files("#files", rooms)
        poses = page.evaluate(ESTIMATED, FOCAL_MM)
    page.close()
    expected = estimate_cameras(rooms, focal=f"{FOCAL_MM}mm")
    assert [view["name"] for view in poses] == names
    for view, camera in zip(poses, expected, strict=True):
        pose = np.reshape(view["pose"], (4, 4))
        angle = np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:3, :3].T @ camera.extrinsics[:3, :3])[0]))
        assert angle < MAX_ROTATION_DEG
        assert np.linalg.norm(pose[:3, 3] - camera.extrinsics[:3, 3]) < MAX_SHIFT
    assert len(found.means) == 2 * 64 * 96


def huge_png(path: Path) -> Path:
    """The header of a PNG of 20,000 x 20,000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", len(header) - 4) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    return path


def test_files_chosen_before_the_service_worker_is_ready_stay(browser, site, captured, monkeypatch):
    ready = threading.Event()

    def hold_worker(self) -> None:
        if self.path.startswith("/service-worker.js"):
            ready.wait(WAIT_S)
        SimpleHTTPRequestHandler.do_GET(self)

    monkeypatch.setattr(StaticHost, "do_GET", hold_worker)
    page = browser.new_page()
    with serving(site) as (address, _):
        page.goto(address)
        page.wait_for_function("document.getElementById('environment').textContent !== ''")
        page.set_input_files("#files", files_of(captured))
        ready.set()
        page.evaluate("navigator.serviceWorker.ready.then(() => null)")
        page.wait_for_timeout(BETWEEN_MS)
        assert page.locator("#chosen li").count() == 3
        assert page.is_enabled("#start")
    page.close()


def test_wrong_files_are_answered(browser, site, captured, tmp_path):
    first, second, _, cameras = files_of(captured)
    text = tmp_path / second.with_suffix(".jpg").name
    text.write_text("not an image")
    broken = tmp_path / "transforms.json"
    broken.write_text("{")
    cases = {
        "at least two": [first, cameras],
        "is no image that this browser reads": [first, text, cameras],
        "has 20000 x 20000 pixels": [first, huge_png(tmp_path / "huge.png"), cameras],
        "no images given": [cameras],
        "is no JSON": [first, second, broken],
    }
    page = browser.new_page()
    with serving(site) as (address, _):
        opened(page, address)
        for message, files in cases.items():
            assert message in reconstruct(page, files, "wasm")
            page.click("#clear")
    page.close()
