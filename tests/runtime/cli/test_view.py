"""The command `idesplat view` in a real browser: the page, and the file to send, show what the rasteriser renders."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras, write_cameras
from idesplat.runtime.cli.view import main, read_viewpoints
from idesplat.runtime.geometry.quaternions import matrices_to_quaternions
from idesplat.runtime.images.png import save_png
from idesplat.runtime.rendering.cameras import overview_camera
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.splats.formats.ply import write_ply
from idesplat.runtime.splats.gaussians import Gaussians, with_colours
from idesplat.tools.evaluation.metrics import ssim

WIDTH, HEIGHT = 320, 240
WHITE = (1.0, 1.0, 1.0)
PATIENCE = 120  # seconds for a page that a CPU renders
# Structural similarity. The page rounds colours and opacities to 8 bits and ends splats at 2.8 standard deviations.
SIMILAR = 0.97
TURNED = 0.9  # at least as different is the same image the wrong way round
FREE = 275  # columns of the page in which the other camera is not to be seen
# viser's own: the corners of its splats have two coordinates, and three.js looks for a third
KNOWN = "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN."
ONLY_THE_SCENE = "body *:not(canvas):not(:has(canvas)) { visibility: hidden !important }"


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Somewhere, turned about every axis, with a unit of length of its own."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.5, 2.0, 0.3]))[0]
    pose[:3, 3] = 300, -200, 50
    K = np.array([[300.0, 0, WIDTH / 2], [0, 300, HEIGHT / 2], [0, 0, 1]])
    return Camera("images/left.png", WIDTH, HEIGHT, K, pose)


@pytest.fixture(scope="module")
def gaussians(camera: Camera) -> Gaussians:
    """A wall in all colours, a blue one before its upper left quarter, and a yellow ball to the right."""
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 33), np.linspace(-0.35, 0.35, 25)))
    wall = np.stack([x, y, np.ones_like(x)], axis=1) * 40
    front = wall[(x < 0) & (y < 0)] * 0.8
    ball = rng.normal(size=(100, 3)) * 0.5 + [8, 3, 30]
    colours = np.stack([x + 0.5, y + 0.5, 0.5 + 0.4 * np.sin(20 * x * y)], axis=1)
    colours = np.concatenate([np.full((len(front), 3), (0.1, 0.1, 0.6)), colours, np.full((100, 3), (1, 0.8, 0))])
    local = np.concatenate([front, wall, ball])  # not in the order in which they are to be composited
    scales = rng.uniform(0.5, 1.2, local.shape) * [1, 1, 0.1]
    turned = np.stack([cv2.Rodrigues(vector)[0] for vector in rng.normal(size=(len(local), 3)) * 0.3])
    quats = matrices_to_quaternions(camera.extrinsics[:3, :3] @ turned)
    means = local @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]
    return with_colours(means, scales, quats, rng.uniform(0.6, 1, len(local)), colours)


@pytest.fixture(scope="module")
def rendered(camera: Camera, gaussians: Gaussians) -> np.ndarray:
    """What the camera sees, by the rasteriser."""
    return render_view(gaussians, camera.extrinsics, camera.K, WIDTH, HEIGHT, WHITE).rgb


@pytest.fixture(scope="module")
def folder(camera: Camera, gaussians: Gaussians, rendered: np.ndarray, tmp_path_factory) -> Path:
    """A splat file, two cameras and their images."""
    folder = tmp_path_factory.mktemp("look")
    write_ply(folder / "scene.ply", gaussians)
    beside = camera.extrinsics.copy()
    beside[:3, 3] += 6 * beside[:3, 0] + 10 * beside[:3, 2]
    right = Camera("images/right.png", WIDTH, HEIGHT, camera.K, beside)
    write_cameras(folder / "cameras.json", [camera, right])
    (folder / "images").mkdir()
    save_png(folder / "images" / "left.png", rendered)
    save_png(folder / "images" / "right.png", np.full((HEIGHT, WIDTH, 3), (1.0, 0, 1.0)))
    return folder


class Page:
    """A page in the browser, and what it complained of and asked for."""

    def __init__(self, browser, address: str) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []
        context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=address.startswith("file:"))
        context.set_default_timeout(1000 * PATIENCE)
        self.page = context.new_page()
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._hear)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)
        self.close = context.close

    def _hear(self, said) -> None:
        if said.type == "error" and not said.text.startswith(KNOWN):
            self.complaints.append(said.text)

    def scene(self, expected: np.ndarray) -> np.ndarray:
        """The scene without what is written over it, once it looks as expected or patience ends.

        [height, width, 3], 0 to 1. Columns that are not expected may show anything.
        """
        self.page.wait_for_selector("canvas")
        self.page.add_style_tag(content=ONLY_THE_SCENE)
        until = time.monotonic() + PATIENCE
        while True:  # splats fade in, and are sorted meanwhile
            shot = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255
            if similarity(shot[:, : expected.shape[1]], expected) > SIMILAR or time.monotonic() > until:
                return shot
            time.sleep(0.5)


def similarity(first: np.ndarray, second: np.ndarray) -> float:
    return ssim(first, second, np.ones(first.shape[:2], bool))


def shows(scene: np.ndarray, rendered: np.ndarray) -> None:
    """An image shows what was rendered, the right way round."""
    assert similarity(scene, rendered) > SIMILAR
    assert similarity(scene[::-1], rendered) < TURNED
    assert similarity(scene[:, ::-1], rendered) < TURNED


@pytest.fixture
def opened(browser):
    """Opens pages, and closes them after the test: they go on rendering."""
    pages = []

    def open_page(address: str) -> Page:
        pages.append(Page(browser, address))
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()


@pytest.fixture
def served(folder):
    """Runs the command with these arguments, and gives the address that it prints."""
    processes = []

    def serve(*arguments) -> str:
        command = [sys.executable, "-c", "from idesplat.runtime.cli.view import main; main()", *map(str, arguments)]
        processes.append(subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True))
        line = processes[-1].stdout.readline()
        return next(word for word in line.split() if word.startswith("http://"))

    yield serve
    for process in processes:
        process.terminate()
        process.wait()


def test_served_page(opened, served, rendered):
    address = served("scene.ply", "--cameras", "cameras.json", "--port", 0, "--no-browser")
    page = opened(address)
    scene = page.scene(rendered[:, :FREE])
    shows(scene[:, :FREE], rendered[:, :FREE])
    assert (scene[:, FREE:].max(axis=2) < 0.3).any()  # the lines of the other camera
    assert page.complaints == []
    assert all(url.startswith((address, "blob:", "data:")) for url in page.requests)


def test_a_click_at_a_camera_leads_there(opened, served, folder, gaussians, rendered):
    cameras = ("--cameras", "cameras.json", "--images", "images")
    page = opened(served("scene.ply", *cameras, "--port", 0, "--no-browser"))
    rows, columns = magenta(page.scene(rendered[:, :FREE])).nonzero()
    page.page.mouse.click(float(np.median(columns)), float(np.median(rows)))  # through the image of the first camera
    right = read_cameras(folder / "cameras.json")[1]
    there = render_view(gaussians, right.extrinsics, right.K, WIDTH, HEIGHT, WHITE).rgb
    assert similarity(there, rendered) < TURNED
    shows(page.scene(there), there)
    assert page.complaints == []


def test_images_from_a_video(tmp_path, camera):
    film = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    for grey in (50, 100, 150):
        film.write(np.full((HEIGHT, WIDTH, 3), grey, np.uint8))
    film.release()
    cameras = [replace(camera, name=f"clip-{number:06}.png") for number in (0, 2)]
    write_cameras(tmp_path / "cameras.json", cameras)
    viewpoints = read_viewpoints(tmp_path / "cameras.json", None, [tmp_path / "clip.avi"])
    assert [round(float(view.image.mean()), -1) for view in viewpoints] == [50, 150]


def magenta(scene: np.ndarray) -> np.ndarray:
    """Where the other camera's image is seen, [height, width]."""
    return (scene > [0.8, -1, 0.8]).all(axis=2) & (scene[..., 1] < 0.3)


def test_file_to_send(opened, folder, rendered, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    html = tmp_path / "<b>scene.html"
    arguments = ("scene.ply", "--cameras", "cameras.json", "--images", "images", "--html", html)
    assert run_command(main, *arguments) == 0
    assert capsys.readouterr().out.startswith(f"wrote {html}: 1,117 Gaussians, ")
    page = opened(html.as_uri())
    scene = page.scene(rendered[:, :FREE])
    shows(scene[:, :FREE], rendered[:, :FREE])
    assert magenta(scene[:, FREE:]).sum() > 500  # the other camera's image; its own is not in the way
    assert page.complaints == []
    assert all(url.startswith(("file:", "blob:", "data:")) for url in page.requests)


def test_scene_without_cameras(opened, folder, gaussians, tmp_path):
    html = tmp_path / "scene.html"
    assert run_command(main, folder / "scene.ply", "--html", html) == 0
    above = overview_camera(gaussians, HEIGHT, WIDTH)
    rendered = render_view(gaussians, above.extrinsics, above.K, WIDTH, HEIGHT, WHITE).rgb
    shows(opened(html.as_uri()).scene(rendered), rendered)


def elsewhere(camera: Camera) -> Camera:
    """A camera with its back to the scene."""
    return replace(camera, extrinsics=camera.extrinsics @ np.diag([-1.0, 1, -1, 1]))


REFUSED = {
    "a page that is none": (("scene.ply", "--html", "scene.ply"), "ends in .html"),
    "a page in no folder": (("scene.ply", "--html", "scene.ply/page.html"), "scene.ply is not a folder"),
    "images without cameras": (("scene.ply", "--images", "images"), "give --cameras"),
    "cameras of another scene": (("scene.ply", "--cameras", "elsewhere.json", "--html", "x.html"), "sees nothing"),
    "no scene": (("nothing.ply",), "nothing.ply"),
    "another machine's address": (("scene.ply", "--host", "203.0.113.1"), "cannot serve at 203.0.113.1"),
    "a host that is none": (("scene.ply", "--host", "not a host"), "cannot serve at not a host"),
}


@pytest.mark.parametrize("arguments, words", REFUSED.values(), ids=REFUSED)
def test_refusals(folder, camera, arguments, words, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    write_cameras(folder / "elsewhere.json", [elsewhere(camera)])
    before = sorted(folder.iterdir())
    assert run_command(main, *arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    assert printed.err.count("\n") == 1
    assert sorted(folder.iterdir()) == before


def test_without_viser(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert run_command(main, folder / "scene.ply") == 2
    assert 'pip install "idesplat[view]"' in capsys.readouterr().err
