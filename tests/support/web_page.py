"""The page of `idesplat web` as its user has it: served, given files, waited for, its downloads read."""

import base64
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_splats
from idesplat.runtime.web.serving import PageHandler

TIMEOUT_MS = 240_000
TOLERANCE = 1e-3  # of a standard deviation, in the median
# Drops files, given as base64 by name, onto the page.
DROP = """(files) => {
  const transfer = new DataTransfer();
  for (const [name, text] of Object.entries(files)) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], name));
  }
  document.getElementById("drop").dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true }));
}"""


class StaticHost(PageHandler):
    """A host that sends no header for cross-origin isolation, as most: the page's service worker adds it."""

    def end_headers(self) -> None:
        SimpleHTTPRequestHandler.end_headers(self)


@contextmanager
def serving(folder: Path, host: type[SimpleHTTPRequestHandler] = StaticHost):
    """The address of a host of the folder, and its server."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(host, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/", server
    finally:
        server.shutdown()
        server.server_close()


def opened(page, address: str) -> None:
    """Open the page, and wait until its service worker has isolated it, for which it reloads once, and it takes files.

    It says what it may run on after all its events have their handlers.
    """
    page.goto(address)
    page.wait_for_function("crossOriginIsolated && navigator.serviceWorker.controller !== null")
    page.wait_for_function("document.getElementById('environment').textContent !== ''")


def drop(page, files: list[Path]) -> None:
    """Drop files onto the page, and wait until it shows the images."""
    page.evaluate(DROP, {path.name: base64.b64encode(path.read_bytes()).decode() for path in files})
    page.wait_for_selector("#start:enabled")


def finished(page, timeout: int = TIMEOUT_MS) -> str:
    """Wait for the end of a reconstruction; the error, empty with a result."""
    page.wait_for_selector("#result[data-ready], #error:not([hidden])", timeout=timeout)
    return page.inner_text("#error")


def reconstruct(page, files: list[Path], provider: str) -> str:
    """Choose the files, start, and wait; the error, empty with a result."""
    page.set_input_files("#files", files)
    page.select_option("#provider", provider)
    page.click("#start")
    return finished(page)


def download(page, link: str, folder: Path) -> Gaussians:
    """The splats of a link of the page."""
    with page.expect_download() as waiting:
        page.click(link)
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return read_splats(path)


def check_equal(found: Gaussians, expected: Gaussians) -> None:
    """Assert that splats are equal to a thousandth of a standard deviation, in the median."""
    for name in ("means", "scales", "quats", "opacities", "sh"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert np.median(np.abs(ours - theirs)) <= TOLERANCE * theirs.std(), name
