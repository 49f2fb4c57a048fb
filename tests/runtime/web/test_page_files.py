"""The files of the page in headless Chromium: those that its user chooses, and those that its service worker keeps.

A reconstruction that the test ends takes the place of the real one.
"""

import shutil
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import pytest
from idesplat.runtime.web.site import FILES_MARK, PAGE
from web_page import DROP, StaticHost, serving

pytestmark = [pytest.mark.browser, pytest.mark.slow]

RECONSTRUCTION = """
export const toSpz = async () => new Blob(["spz"]);
export const reconstruct = (files) => new Promise((resolve) => {
  const depth = { data: new Float32Array(1), views: 1, height: 1, width: 1 };
  const numbers = { near: 1, far: 2, threads: 1, memory: 1, seconds: {} };
  const result = { ply: new Blob(["ply"]), gaussians: { count: 1 }, depth, cameras: [], notes: [], ...numbers };
  globalThis.given = files;
  globalThis.end = () => resolve(result);
});
"""
# Keeps the URLs of blobs that are not revoked.
COUNT_URLS = """
globalThis.urls = new Set();
const { createObjectURL, revokeObjectURL } = URL;
URL.createObjectURL = (blob) => { const url = createObjectURL(blob); urls.add(url); return url; };
URL.revokeObjectURL = (url) => { urls.delete(url); revokeObjectURL(url); };
"""
UNREADABLE = (
    "DataTransferItem.prototype.webkitGetAsEntry = () => ({ isFile: true, file: (_, no) => no(new Error('gone')) })"
)
# The state in which the installation of the service worker ends.
INSTALL = """async () => {
  const { installing } = await navigator.serviceWorker.register("service-worker.js");
  while (!["activated", "redundant"].includes(installing.state)) {
    await new Promise((resolve) => installing.addEventListener("statechange", resolve, { once: true }));
  }
  return installing.state;
}"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("files") / "page"
    shutil.copytree(PAGE, folder)
    (folder / "idesplat.js").write_text(RECONSTRUCTION)
    (folder / "model.json").write_text("{}")
    return folder


@pytest.fixture
def page(browser, folder):
    """The page, without its service worker."""
    page = browser.new_context(service_workers="block").new_page()
    page.add_init_script(COUNT_URLS)
    with serving(folder) as (address, _):
        page.goto(address)
        page.wait_for_function("document.getElementById('environment').textContent !== ''")
        yield page
    page.context.close()


def choose(page, *names: str, content: bytes = b"1") -> None:
    page.set_input_files("#files", [{"name": name, "mimeType": "image/png", "buffer": content} for name in names])


def run(page) -> None:
    """Start, and wait until the result is shown."""
    page.click("#start")
    page.wait_for_function("(globalThis.end ?? null) !== null")
    page.evaluate("end(); globalThis.end = null")
    page.wait_for_selector("#start:enabled")


def test_files_added_in_a_run_do_not_start_another(page) -> None:
    choose(page, "0.png", "1.png")
    page.click("#start")
    page.wait_for_selector("#stop:not([hidden])")
    choose(page, "2.png")
    assert page.locator("#chosen li").count() == 3
    assert page.is_disabled("#start")
    page.evaluate("end()")
    page.wait_for_selector("#start:enabled")


def test_a_drop_that_cannot_be_read_is_answered(page) -> None:
    page.evaluate(UNREADABLE)
    page.evaluate(DROP, {"0.png": ""})
    page.wait_for_selector("#error:not([hidden])")
    assert page.inner_text("#error").startswith("the dropped files cannot be read (gone)")


def test_an_image_replaces_one_with_its_name(page) -> None:
    choose(page, "0.png", "1.png", content=b"old")
    choose(page, "0.png", content=b"new")
    page.click("#start")
    page.wait_for_function("globalThis.given")
    texts = page.evaluate("Promise.all(given.map(async (file) => [file.name, await file.text()]))")
    assert texts == [["1.png", "old"], ["0.png", "new"]]


def test_urls_that_are_replaced_are_revoked(page) -> None:
    def count() -> int:
        return page.evaluate("urls.size")

    choose(page, "0.png", "1.png")
    choose(page, "1.png")
    assert count() == 2
    run(page)
    run(page)
    assert count() == 2 + 2  # of the thumbnails and of the downloads
    page.click("#clear")
    assert count() == 0


def worker_folder(folder: Path, files: str) -> Path:
    """A page with nothing but the service worker, which keeps these files from the start."""
    text = (PAGE / "service-worker.js").read_text()
    (folder / "service-worker.js").write_text(text.replace(FILES_MARK, f"FILES = {files}"))
    (folder / "index.html").write_text("<!doctype html><title>page</title>")
    return folder


def test_a_service_worker_without_a_file_is_not_used(browser, tmp_path: Path) -> None:
    page = browser.new_page()
    with serving(worker_folder(tmp_path, '["./", "missing.js"]')) as (address, _):
        page.goto(address)
        assert page.evaluate(INSTALL) == "redundant"
    page.close()


def test_the_service_worker_asks_whether_files_are_current(browser, tmp_path: Path, monkeypatch) -> None:
    asked = {}

    def note(self) -> None:
        asked[self.path] = self.headers["Cache-Control"]
        SimpleHTTPRequestHandler.do_GET(self)

    monkeypatch.setattr(StaticHost, "do_GET", note)
    (tmp_path / "kept.js").write_text("1")
    (tmp_path / "late.txt").write_text("1")
    page = browser.new_page()
    with serving(worker_folder(tmp_path, '["./", "kept.js"]')) as (address, _):
        page.goto(address)
        assert page.evaluate(INSTALL) == "activated"
        page.wait_for_function("navigator.serviceWorker.controller !== null")
        assert page.evaluate("fetch('late.txt').then((response) => response.text())") == "1"
    page.close()
    assert (asked["/kept.js"], asked["/late.txt"]) == ("max-age=0", "max-age=0")
