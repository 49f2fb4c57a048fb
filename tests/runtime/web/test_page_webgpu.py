"""The page on WebGPU in headless Chromium, with an adapter in software: `make webgpu`."""

from pathlib import Path

import pytest
from conftest import run_command
from idesplat.runtime.cli.web import main as web
from idesplat.runtime.web import third_party
from web_page import check_equal, download, drop, finished, opened, serving

SIZE = "64x96"
TIMEOUT_MS = 900_000
GPU_FLAGS = "--enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan"


@pytest.mark.browser
@pytest.mark.webgpu
def test_webgpu_gives_the_splats_of_webassembly(chromium, scene: Path, tmp_path: Path) -> None:
    """The bundled model, from dropped files to downloaded splats, WebGPU chosen by hand.

    Left to itself, the page runs on WebAssembly and says so: it is faster than an adapter in software.
    """
    if not third_party.VENDOR.is_dir():
        pytest.skip("the npm files of the page are not there; make web")
    site = tmp_path / "site"
    assert run_command(web, site, "--size", SIZE) == 0
    browser = chromium(GPU_FLAGS)
    page = browser.new_context(reduced_motion="reduce").new_page()
    with serving(site) as (address, _):
        opened(page, address)
        if not page.evaluate("async () => 'gpu' in navigator && (await navigator.gpu.requestAdapter()) !== null"):
            pytest.skip("this Chromium has no WebGPU adapter")
        drop(page, [*sorted((scene / "images").iterdir()), scene / "transforms.json"])
        found = {}
        for provider, device in (("webgpu", "WebGPU"), ("", "WebAssembly")):
            page.select_option("#provider", provider)
            page.click("#start")
            page.wait_for_selector("#progress:not([hidden])")
            page.wait_for_selector("#progress[hidden]", state="attached", timeout=TIMEOUT_MS)
            assert finished(page) == ""
            assert device in page.inner_text("#numbers")
            found[provider] = download(page, "#ply", tmp_path)
        assert "the WebGPU adapter is software; WebAssembly is used" in page.inner_text("#notes")
    browser.close()
    check_equal(found["webgpu"], found[""])
