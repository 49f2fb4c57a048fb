"""Graphs for WebGPU: standard, without loops, equal to the network, and wholly on the device in headless Chromium."""

import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from conftest import run_command
from idesplat import Predictor
from idesplat.export import cli
from idesplat.export.example_inputs import room_inputs
from idesplat.runtime.inference.session import open_session, run_session

RUNTIME = Path(__file__).parents[2] / "docs" / "examples" / "node_modules" / "onnxruntime-web" / "dist"
SIDE = 64
GPU_FLAGS = "--enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan"
PLACED = re.compile(r"Node\(s\) placed on \[(\w+)\]\. Number of nodes: (\d+)")
# Opens the graph on WebGPU, with ONNX Runtime's log in the console; runs it once where it has inputs.
SCRIPT = """async (shapes) => {
    const ort = await import("/runtime/ort.webgpu.bundle.min.mjs");
    ort.env.wasm.numThreads = 1;
    ort.env.wasm.wasmPaths = "/runtime/";
    ort.env.logLevel = "verbose";
    const options = {executionProviders: ["webgpu"], logSeverityLevel: 0};
    const session = await ort.InferenceSession.create("/model.onnx", options);
    ort.env.logLevel = "warning";
    if (!shapes) return null;
    const feeds = {};
    for (const name of session.inputNames) {
        const values = await (await fetch(`/${name}.f32`)).arrayBuffer();
        feeds[name] = new ort.Tensor("float32", new Float32Array(values), shapes[name]);
    }
    const results = await session.run(feeds);
    return Array.from(await results.depth.getData());
}"""


@pytest.fixture(scope="module")
def inputs() -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in room_inputs(2, SIDE, SIDE, 0.5, 20.0).items()}


@pytest.fixture(scope="module")
def graph(small_checkpoint, presets, kept_traces, tmp_path_factory) -> Path:
    """The small network for WebGPU at one size."""
    path = tmp_path_factory.mktemp("web") / "model.onnx"
    size = ("--views", 2, "--size", f"{SIDE}x{SIDE}")
    assert run_command(cli.main, small_checkpoint, path, "--target", "web", *size) == 0
    return path


def operators(path: Path) -> set[str]:
    return {node.op_type for node in onnx.load(path).graph.node}


def test_it_is_standard_and_has_no_loop(graph: Path) -> None:
    model = onnx.load(graph)
    assert {node.domain for node in model.graph.node} == {""}
    assert not operators(graph) & {"Loop", "Scan", "If", "Round", "Range", "ConstantOfShape", "Shape"}
    assert Predictor(graph).metadata.target == "web"


def test_it_computes_what_the_graph_for_cpus_does(graph: Path, exported: tuple[Path, Path], inputs) -> None:
    found, expected = (run_session(open_session(path), inputs) for path in (graph, exported[0]))
    for name, values in expected.items():
        assert np.median(np.abs(found[name] - values)) < 1e-4 * values.std(), name


@pytest.mark.slow
def test_with_dynamic_sizes_it_has_no_loop_either(
    small_checkpoint, presets, kept_traces, exported, inputs, tmp_path
) -> None:
    path = tmp_path / "gpu.onnx"
    assert run_command(cli.main, small_checkpoint, path, "--target", "gpu", "--no-verify") == 0
    assert not operators(path) & {"Loop", "Round"}
    found, expected = (run_session(open_session(model), inputs) for model in (path, exported[0]))
    assert np.median(np.abs(found["depth"] - expected["depth"])) < 1e-4 * expected["depth"].std()


@pytest.fixture
def address(graph: Path, inputs, tmp_path: Path) -> Iterator[str]:
    """A server of the graph, its inputs and onnxruntime-web, on the loopback address."""
    if not RUNTIME.is_dir():
        pytest.skip("onnxruntime-web is not installed: npm install --prefix docs/examples")
    (tmp_path / "runtime").symlink_to(RUNTIME)
    (tmp_path / "model.onnx").symlink_to(graph)
    (tmp_path / "index.html").write_text("<!doctype html><title>WebGPU</title>")
    for name, values in inputs.items():
        values.tofile(tmp_path / f"{name}.f32")
    handler = partial(_QuietHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


class _QuietHandler(SimpleHTTPRequestHandler):
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript", ".wasm": "application/wasm"}

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def run_in_browser(chromium, address: str) -> Iterator[Callable[[dict[str, list[int]] | None], tuple[Any, list[str]]]]:
    """Runs the script in a page; its result and the lines of the console."""
    browser = chromium(GPU_FLAGS)
    console: list[str] = []

    def run(shapes: dict[str, list[int]] | None) -> tuple[Any, list[str]]:
        page = browser.new_page()
        page.set_default_timeout(0)
        page.on("console", lambda message: console.append(message.text))
        page.goto(address)
        if not page.evaluate("async () => 'gpu' in navigator && (await navigator.gpu.requestAdapter()) !== null"):
            pytest.skip("this Chromium has no WebGPU adapter")
        return page.evaluate(SCRIPT, shapes), console

    yield run
    browser.close()


@pytest.mark.browser
@pytest.mark.slow
def test_every_node_is_on_the_device(run_in_browser) -> None:
    """No node on the CPU, and no copy between memories."""
    _, console = run_in_browser(None)
    placed = {provider: int(count) for line in console for provider, count in PLACED.findall(line)}
    assert set(placed) <= {"WebGpuExecutionProvider"} or placed.get("CPUExecutionProvider") == 0, placed
    if placed:
        assert placed["WebGpuExecutionProvider"] > 1000
    else:
        assert any("All nodes placed on [WebGpuExecutionProvider]" in line for line in console)
    assert not [line for line in console if "MemcpyToHost" in line or "MemcpyFromHost" in line]


@pytest.mark.browser
@pytest.mark.webgpu
def test_it_computes_the_same_on_webgpu(run_in_browser, graph: Path, inputs) -> None:
    depth, _ = run_in_browser({name: list(values.shape) for name, values in inputs.items()})
    expected = run_session(open_session(graph), inputs)["depth"]
    error = np.abs(np.array(depth, np.float32) - expected.ravel()) / expected.std()
    assert np.median(error) < 1e-4
    assert np.percentile(error, 99) < 1e-2
