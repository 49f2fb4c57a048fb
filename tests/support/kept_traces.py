"""Exports in less time: traces that are kept for further exports of the same network, and fewer verification cases."""

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import onnx
import pytest
from idesplat.export import tracing
from idesplat.export.stages import NamedTensors
from idesplat.export.targets import OPSET
from idesplat.export.tracing import WEIGHTS, StaticShape
from idesplat.export.validation import compare
from idesplat.export.validation.cases import verification_cases
from idesplat.runtime.inference.metadata import ModelMetadata
from shared_fixtures import build_once

GRAPH = "graph.onnx"


def keeping_trace(factory: pytest.TempPathFactory) -> Callable[..., onnx.ModelProto]:
    """`idesplat.export.tracing.trace`, which copies what it made before of the same network, weights and sizes."""
    trace = tracing.trace

    def kept(
        network: NamedTensors, metadata: ModelMetadata, static: StaticShape, folder: Path, opset: int = OPSET
    ) -> onnx.ModelProto:
        sizes = (opset, static, metadata.near, metadata.far, metadata.size_multiple)
        key = hashlib.sha256(repr((network.model.config, sizes)).encode())
        for name, value in network.state_dict().items():
            key.update(name.encode() + value.numpy().tobytes())

        def build(target: Path) -> None:
            model = trace(network, metadata, static, target, opset)
            (target / GRAPH).write_bytes(model.SerializeToString())

        made = build_once(factory, f"trace-{key.hexdigest()[:16]}", build)
        shutil.copy(made / WEIGHTS, folder)
        return onnx.load(made / GRAPH, load_external_data=False)

    return kept


@contextmanager
def one_verification_case() -> Iterator[None]:
    """Inside, an export is verified with the first of its cases alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "verification_cases", lambda *given: islice(verification_cases(*given), 1))
        yield
