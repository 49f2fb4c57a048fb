"""The page in headless Chromium: from chosen files to a downloaded splat, and wrong files."""

import base64
import io
import json
import struct
import threading
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.cli.infer import main as infer
from idesplat.runtime.cli.web import main as web
from idesplat.runtime.geometry.intrinsics import intrinsic_matrix
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_splats
from idesplat.runtime.web import third_party
from idesplat.runtime.web.serving import page_server
from PIL import Image
from shared_fixtures import build_once

pytestmark = pytest.mark.slow

SIZE = "64x96"
TIMEOUT_MS = 240_000
TOLERANCE = 1e-3  # of a standard deviation, in the median
# Of the viewer's image against the rasteriser's: they sort and filter differently. Upside down it has half as much.
MIN_PSNR = 26
SETTLED_MS = 4000  # until the viewer has sorted the splats and stopped drawing


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


@contextmanager
def serving(folder: Path):
    """The address of a server of the folder, and the server."""
    server = page_server(folder, "127.0.0.1", 0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/", server
    finally:
        server.shutdown()
        server.server_close()


def files_of(scene: Path) -> list[Path]:
    return [*sorted((scene / "images").iterdir()), scene / "transforms.json"]


def reconstruct(page, files, provider: str) -> str:
    """Choose the files, start, and wait; the error, empty with a result."""
    page.set_input_files("#files", files)
    page.select_option("#provider", provider)
    page.click("#start")
    page.wait_for_selector("#result[data-ready], #error:not([hidden])", timeout=TIMEOUT_MS)
    return page.inner_text("#error")


def download(page, link: str, folder: Path) -> Gaussians:
    with page.expect_download() as waiting:
        page.click(link)
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return read_splats(path)


def check_equal(found: Gaussians, expected: Gaussians) -> None:
    for name in ("means", "scales", "quats", "opacities", "sh"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert np.median(np.abs(ours - theirs)) <= TOLERANCE * theirs.std(), name


def test_wasm_from_files_to_splats_and_again_offline(browser, site, captured, expected, tmp_path):
    context = browser.new_context(viewport={"width": 400, "height": 500}, reduced_motion="reduce")
    page = context.new_page()
    complaints, requests = [], []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    context.on("request", lambda request: requests.append(request.url))
    with serving(site) as (address, server):
        page.goto(address)
        page.wait_for_function("crossOriginIsolated && navigator.serviceWorker.controller !== null")
        assert reconstruct(page, files_of(captured), "wasm") == ""
        found = download(page, "#ply", tmp_path)
        check_equal(found, expected)
        packed = download(page, "#spz", tmp_path)
        assert np.abs(packed.means - found.means).max() <= 2.0**-22 * max(1, np.abs(found.means).max())
        assert np.abs(packed.opacities - found.opacities).max() <= 1 / 255
        check_seen_upright(page, found, read_cameras(captured / "transforms.json"))
        server.shutdown()
        server.server_close()
        page.reload()
        assert reconstruct(page, files_of(captured), "wasm") == ""
        check_equal(download(page, "#ply", tmp_path), expected)
    context.close()
    assert complaints == []
    assert {url for url in requests if not url.startswith((address, "blob:", "data:"))} == set()


def check_seen_upright(page, gaussians: Gaussians, cameras: list[Camera]) -> None:
    """What the canvas shows is what the rasteriser renders from the first view, and not that upside down."""
    page.wait_for_timeout(SETTLED_MS)
    encoded = page.evaluate("document.getElementById('view').toDataURL()").partition(",")[2]
    shown = Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB")
    name = page.inner_text("#depth figcaption >> nth=0")
    camera = next(camera for camera in cameras if camera.name == name)
    width, height = shown.size
    # The view fits the canvas, in whose middle the optical axis is.
    tangent = max(camera.height / camera.K[1, 1] / 2, camera.width / camera.K[0, 0] / 2 / (width / height))
    focal = height / 2 / tangent
    K = intrinsic_matrix(focal, focal, width / 2, height / 2)
    rendered = np.clip(render_view(gaussians, camera.extrinsics, K, width, height).rgb, 0, 1)
    pixels = np.asarray(shown, np.float32) / 255
    assert psnr(pixels, rendered) > MIN_PSNR
    assert psnr(pixels[::-1], rendered) < MIN_PSNR - 6


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_webgpu_is_refused_for_a_graph_that_was_not_exported_for_it(browser, site, captured):
    """There it would be wrong without an error."""
    page = browser.new_page()
    with serving(site) as (address, _):
        page.goto(address)
        page.set_input_files("#files", files_of(captured))
        call = "cameras => import('./idesplat.js').then(({ reconstruct }) => reconstruct(files.files, cameras, "
        call += "{ provider: 'webgpu' })).catch((error) => error.message)"
        answer = page.evaluate(call, json.loads((captured / "transforms.json").read_text()))
        page.wait_for_function("document.querySelector('#provider').value === 'wasm'")
    page.close()
    assert answer == "the graph of this page was not exported for WebGPU; choose WebAssembly"


def huge_png(path: Path) -> Path:
    """The header of a PNG of 20,000 x 20,000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", len(header) - 4) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    return path


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
        page.goto(address)
        page.wait_for_function("crossOriginIsolated && navigator.serviceWorker.controller !== null")
        for message, files in cases.items():
            assert message in reconstruct(page, files, "wasm")
            page.click("#clear")
    page.close()
