"""Settings of all tests, and what many of them share: a small network, its export, a synthetic scene, a browser.

The fixtures of scope `session` are made once in a run, also where it has several processes (pytest-xdist): see
support/shared_fixtures.py. Call a command with `run_command` in the test's own process; a subprocess costs the imports
again.
"""

import os
import shutil
import signal
import sys
from pathlib import Path

# Compiled code is kept between test runs, but not in the user's cache.
os.environ["NUMBA_CACHE_DIR"] = str(Path(__file__).parent.parent / ".pytest_cache" / "numba")
os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(Path(__file__).parent.parent / ".pytest_cache" / "torch")

import idesplat.runtime  # noqa: F401  # first: it switches ONNX Runtime's telemetry off
import pytest
import torch
from hypothesis import settings
from idesplat.model.config import DPTConfig, UNetConfig, ViTConfig
from idesplat.model.idesplat.config import DPBUConfig, FocusConfig, IDESplatConfig
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS
from shared_fixtures import build_once

# No limit on an example's time: a busy machine is no fault of the code.
settings.register_profile("idesplat", deadline=None)
settings.load_profile("idesplat")

SMALL_PRESET = "idesplat-small"
CHECKPOINT_NAME = "idesplat-small.pth"
SMALL = IDESplatConfig(
    backbone_channels=(16, 24, 32),
    feature_channels=32,
    transformer_layers=2,
    vit=ViTConfig(dim=48, depth=4, heads=3, grid=5, out_indices=(0, 1, 2, 3)),
    dpt=DPTConfig(features=16, channels=(12, 24, 32, 48), disparity_channels=8),
    dpbus=(
        DPBUConfig(channels=64, candidates=33, scale=1, unet=UNetConfig(channels=32, levels=3)),
        DPBUConfig(channels=16, candidates=17, scale=2, unet=UNetConfig(channels=16, levels=4)),
        DPBUConfig(channels=8, candidates=9, scale=4, unet=UNetConfig(channels=8, levels=5)),
    ),
    residual_unet=UNetConfig(channels=8, levels=5),
    focus=FocusConfig(channels=32, heads=4, topk=(256, 128, 64)),
    height=64,
    width=96,
)


def small_network() -> IDESplat:
    """The small network with weights that are always the same."""
    torch.manual_seed(0)
    return IDESplat(SMALL).eval()


def _default_signals() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


# For `preexec_fn`: children inherit that a shell ignores SIGINT of background commands, and nohup SIGHUP.
DEFAULT_SIGNALS = None if os.name == "nt" else _default_signals


def run_command(main, *arguments) -> int:
    """Call a command's entry point in this process, with these arguments on its command line; its exit status."""
    before = sys.argv
    sys.argv = ["command", *map(str, arguments)]
    try:
        main()
    except SystemExit as stop:
        return stop.code or 0
    finally:
        sys.argv = before
    return 0


def pytest_configure(config: pytest.Config) -> None:
    """Give each of several processes its own cores, or one: ONNX Runtime's threads wait actively for each other."""
    worker = getattr(config, "workerinput", None)
    if worker is not None and hasattr(os, "sched_setaffinity"):
        number, count = int(worker["workerid"].removeprefix("gw")), int(worker["workercount"])
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, set(cores[number::count]) or {cores[number % len(cores)]})


# Fixtures that export a network, train one, or make the weights of a released one.
SLOW_FIXTURES = {"exported", "kept_traces", "finished", "released"}
# Made once for all processes.
SHARED_FIXTURES = {"exported", "kept_traces"}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by their fixtures, skip those of POSIX on Windows, and run the files with slow tests first.

    With the slow files first, two processes end at about the same time. While one makes what several files share, the
    other runs slow files that need none of it.
    """
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if "browser" in fixtures:
            item.add_marker("browser")
        if fixtures & SLOW_FIXTURES or item.get_closest_marker("parity"):
            item.add_marker("slow")
        if os.name == "nt" and item.get_closest_marker("posix"):
            item.add_marker(pytest.mark.skip(reason="needs POSIX"))
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    sharing = {item.path for item in items if SHARED_FIXTURES & set(getattr(item, "fixturenames", ()))}
    maker = min(sharing, default=None)
    items.sort(key=lambda item: (item.path != maker, item.path not in slow, item.path in sharing))


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Give the tests a cache folder of their own instead of the user's."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


@pytest.fixture(scope="session")
def presets():
    """The small network as a preset, for as long as the tests run."""
    PRESETS[SMALL_PRESET] = SMALL
    yield
    del PRESETS[SMALL_PRESET]


@pytest.fixture(scope="session")
def small_checkpoint(tmp_path_factory) -> Path:
    """The small network's weights, as a release saves them."""
    folder = build_once(
        tmp_path_factory,
        "checkpoint",
        lambda folder: torch.save(small_network().state_dict(), folder / CHECKPOINT_NAME),
    )
    return folder / CHECKPOINT_NAME


@pytest.fixture(scope="session")
def kept_traces(tmp_path_factory):
    """From here on, a network is traced once in a run of the tests, however often it is exported."""
    from idesplat.export import tracing
    from kept_traces import keeping_trace

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracing, "trace", keeping_trace(tmp_path_factory))
        yield


@pytest.fixture(scope="session")
def exported(small_checkpoint, presets, kept_traces, tmp_path_factory) -> tuple[Path, Path]:
    """The small network as a fused file and as a staged folder, through the command, verified with one case.

    tests/export/validation/test_verification.py compares all cases.
    """
    from idesplat.export.cli import main
    from kept_traces import one_verification_case

    def export(folder: Path) -> None:
        arguments = (small_checkpoint, folder / "model.onnx", "--staged", folder / "staged")
        with one_verification_case():
            assert run_command(main, *arguments) == 0

    folder = build_once(tmp_path_factory, "exported", export)
    return folder / "model.onnx", folder / "staged"


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A folder with five images of a synthetic room, 96 x 128, their depth, and transforms.json."""
    from idesplat.tools.synthetic.make_scene import make_scene

    return build_once(
        tmp_path_factory, "scene", lambda folder: make_scene(folder, seed=2, views=5, height=96, width=128)
    )


@pytest.fixture(scope="session")
def chromium():
    """Starts headless Chromium with further flags: a function that returns the browser, which its caller closes."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("neither chromium nor google-chrome is installed")
    from playwright.sync_api import sync_playwright

    usual = (
        "--no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
        "--disable-sync --hide-scrollbars"
    )
    with sync_playwright() as playwright:
        yield lambda flags: playwright.chromium.launch(executable_path=path, args=f"{usual} {flags}".split())


@pytest.fixture(scope="session")
def browser(chromium):
    """Headless Chromium, which renders WebGL on the CPU."""
    browser = chromium("--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader")
    yield browser
    browser.close()
