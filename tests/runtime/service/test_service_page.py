"""The page of the service in a browser: with the keyboard, at a phone's width, from images to the downloaded file."""

import pytest
from running_service import running_service
from tiny_model import write_model

pytestmark = pytest.mark.slow

TOKEN = "secret"
WIDTH = 390  # pixels, of a phone


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with running_service(folder, "--model", write_model(folder / "tiny.onnx"), token=TOKEN) as running:
        yield running


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_makes_splats_of_images(browser, service, scene, scheme, tmp_path):
    context = browser.new_context(viewport={"width": WIDTH, "height": 700}, color_scheme=scheme)
    page = context.new_page()
    problems, elsewhere = [], []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: elsewhere.append(request.url) if service.url not in request.url else None)
    page.goto(service.url)
    images = sorted((scene / "images").iterdir())[:3]
    page.set_input_files("#files", [*images, scene / "transforms.json"])
    assert page.inner_text("#chosen") == "3 images, 1 file of cameras"
    page.select_option("#quality", "fast")
    page.focus("#start")
    page.keyboard.press("Enter")
    page.wait_for_selector("#token-row:not([hidden])")
    assert "needs a token" in page.inner_text("#error")
    page.keyboard.type(TOKEN)  # its field has the focus
    page.keyboard.press("Enter")
    page.wait_for_selector("#result:not([hidden])", timeout=120_000)
    page.wait_for_selector("#frame[src^='blob:']")
    page.wait_for_selector("#depth img:nth-of-type(2)")
    assert "Gaussians from 000.png" in page.inner_text("#facts")
    first = page.get_attribute("#frame", "src")
    page.focus("#position")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(f"#frame:not([src='{first}'])")
    assert page.evaluate("document.getElementById('frame').decode().then(() => true)")
    page.select_option("#format", ".splat")
    with page.expect_download() as download:
        page.click("#download")
    download.value.save_as(tmp_path / "scene.splat")
    assert download.value.suggested_filename == "scene.splat"
    assert (tmp_path / "scene.splat").stat().st_size % 32 == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= WIDTH
    page.set_input_files("#files", images[:1])
    page.click("#start")
    page.wait_for_selector("#error:not([hidden])")
    assert "1 images, expected 2" in page.inner_text("#error")
    assert [url for url in elsewhere if not url.startswith(("blob:", "data:"))] == []
    assert all("401" in problem or "422" in problem for problem in problems), problems
    context.close()
