"""What sessions take."""

import multiprocessing
import sys

import numpy as np
import onnx.parser
import pytest
from idesplat.runtime.inference.session import open_session, run_session
from idesplat.tools.benchmark.worker import peak_bytes

# Large tensors that nobody sees, of 200 MB each.
GRAPH = """<ir_version: 10, opset_import: ["": 20]>
net (float[1] x) => (float[1] sum) {
    shape = Constant <value_ints = [50000000]> ()
    many = Expand (x, shape)
    roots = Sqrt (many)
    sum = ReduceSum <keepdims = 1> (roots)
}"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads what memory a process took from /proc")
def test_a_second_run_takes_no_more_memory_than_the_first():
    with multiprocessing.get_context("spawn").Pool(1) as pool:  # pytest itself may have taken more before
        before, first, second = pool.apply(_peaks_of_two_runs)
    assert first - before > 300
    assert second - first < 30


def _peaks_of_two_runs() -> list[float]:
    """The most memory held before, until after a first and until after a second run, in MB."""
    session = open_session(onnx.parser.parse_model(GRAPH).SerializeToString())
    peaks = [peak_bytes() / 1e6]
    for _ in range(2):
        run_session(session, {"x": np.ones(1, np.float32)})
        peaks.append(peak_bytes() / 1e6)
    return peaks
