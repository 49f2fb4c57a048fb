"""The files of the page in headless Chromium: those that its user chooses, those that its service worker keeps, and
those that its worker may fetch.

A reconstruction that the test ends takes the place of the real one.
"""

import shutil
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import ClassVar

import pytest
from idesplat.runtime.web.serving import PageHandler
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
# In place of the worker: sends what it was given to another host.
UPLOADING = """self.onmessage = async ({ data }) => {
  const sent = await fetch(data.cameras, { method: "POST", body: "photograph" }).then(() => "sent", () => "refused");
  self.postMessage({ kind: "error", message: sent });
};"""
# What a reconstruction with the page's own module is answered.
ANSWER = """(cameras) => import("./idesplat.js").then(({ reconstruct }) => reconstruct([], cameras)).catch(
  (error) => error.message)"""
# The state in which the installation of the service worker ends.
INSTALL = """async () => {
  const { installing } = await navigator.serviceWorker.register("service-worker.js");
  while (!["activated", "redundant"].includes(installing.state)) {
    await new Promise((resolve) => installing.addEventListener("statechange", resolve, { once: true }));
  }
  return installing.state;
}"""


class OpenHost(StaticHost):
    """A host that takes uploads from everywhere."""

    received: ClassVar[list[str]] = []

    def end_headers(self) -> None:
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def do_POST(self) -> None:
        self.received.append(self.path)
        self.send_response(200)
        self.end_headers()


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


def test_a_failed_installation_of_the_service_worker_is_told(browser, tmp_path: Path) -> None:
    shutil.copytree(PAGE, tmp_path / "page")
    text = (PAGE / "service-worker.js").read_text()
    (tmp_path / "page" / "service-worker.js").write_text(text.replace(FILES_MARK, 'FILES = ["missing.js"]'))
    page = browser.new_page()
    with (
        serving(tmp_path / "page") as (address, _),
        page.expect_console_message(lambda said: said.text.startswith("without a service worker")),
    ):
        page.goto(address)
    page.close()


@pytest.mark.parametrize("isolated", [True, False])
def test_the_worker_reaches_no_other_host(browser, tmp_path: Path, monkeypatch, isolated: bool) -> None:
    """Neither on a host that isolates the page nor on another; the host that is asked would allow it."""
    monkeypatch.setattr(OpenHost, "received", [])
    shutil.copytree(PAGE, tmp_path / "page")
    (tmp_path / "page" / "worker.js").write_text(UPLOADING)
    page = browser.new_context(service_workers="block").new_page()
    host = PageHandler if isolated else StaticHost
    with serving(tmp_path / "page", host) as (address, _), serving(tmp_path, OpenHost) as (other, _):
        page.goto(address)
        assert page.evaluate("crossOriginIsolated") == isolated
        assert page.evaluate(ANSWER, other) == "refused"
    page.context.close()
    assert OpenHost.received == []


def test_a_worker_whose_files_are_missing_is_told(browser, tmp_path: Path) -> None:
    shutil.copytree(PAGE, tmp_path / "page")
    (tmp_path / "page" / "worker.js").unlink()
    page = browser.new_context(service_workers="block").new_page()
    with serving(tmp_path / "page") as (address, _):
        page.goto(address)
        assert page.evaluate(ANSWER, None) == "the worker failed (its files cannot be loaded); reload the page"
    page.context.close()
