"""What a session leaves behind."""

import multiprocessing
import sys
from pathlib import Path

import numpy as np
import onnx.parser
import pytest
from idesplat.runtime.session import open_session, run_session

# Large tensors that nobody sees, of 200 MB each. (What a session takes first it keeps, so that is small.)
GRAPH = """<ir_version: 10, opset_import: ["": 20]>
net (float[1] x) => (float[1] sum) {
    shape = Constant <value_ints = [50000000]> ()
    positive = Abs (x)
    many = Expand (positive, shape)
    roots = Sqrt (many)
    sum = ReduceSum <keepdims = 1> (roots)
}"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads what memory a process has from /proc")
def test_the_memory_of_a_run_is_given_back():
    with multiprocessing.get_context("spawn").Pool(1) as pool:  # pytest's own memory goes up and down
        before, after, peak = pool.apply(_megabytes_around_a_run)
    assert peak - before > 300
    assert after - before < 30


def _megabytes_around_a_run() -> tuple[float, float, float]:
    session = open_session(onnx.parser.parse_model(GRAPH).SerializeToString())
    before = _megabytes("VmRSS")
    run_session(session, {"x": np.ones(1, np.float32)})
    return before, _megabytes("VmRSS"), _megabytes("VmHWM")


def _megabytes(entry: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(entry)).split()[1]) / 1e3
