"""The folder of the page: our files, those of third parties, the graph, and a list of what they are."""

import gzip
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..inference.model_files import ModelFiles
from ..system.files import atomic_write, make_folder
from ..system.outputs import outputs
from ..system.progress import working
from .graph import VIEWS, page_graph
from .third_party import pinned_packages, third_party_files

PAGE = Path(__file__).with_name("page")
MODEL, GRAPH, WORKER, LICENCES = "model.json", "model.onnx.gz", "service-worker.js", "lib/third-party.json"
PACKED_SUFFIX = ".gz"  # of files that the page unpacks, so that a host need not compress them
COMPRESSION = 6  # 9 takes twice as long for 1 % less
# In the service worker: replaced by a digest of all files, and by the files that it keeps from the start.
VERSION_MARK, FILES_MARK = "DEVELOPMENT", 'FILES = ["./"]'
VERSION_LENGTH = 16
TEXT_SUFFIXES = (".html", ".css", ".js", ".mjs", ".json", ".ts")


@dataclass(frozen=True)
class Site:
    """What was written. download: bytes of all files as a host sends them, texts compressed."""

    files: list[Path]
    download: int


def write_site(folder: Path, model: ModelFiles, size: tuple[int, int] | None = None) -> Site:
    """Write the page into a folder, for any static host.

    size: height and width that the model works at; by default those of the training.
    Raises InputError if the model cannot run in a page, a package is missing, or a file cannot be written.
    """
    content = {path.relative_to(PAGE).as_posix(): path.read_bytes() for path in _page_files()}
    content |= _third_party()
    with working("fixing the sizes of the graph"):
        graph = page_graph(model, size)
        content[GRAPH] = _packed(graph.content)
    own = model.metadata
    description = {
        "name": own.preset,
        "file": GRAPH,
        "sha256": hashlib.sha256(graph.content).hexdigest(),
        "views": VIEWS,
        "height": graph.height,
        "width": graph.width,
        "webgpu": graph.webgpu,
        "near": own.near,
        "far": own.far,
    }
    content[MODEL] = (json.dumps(description, indent=1) + "\n").encode()
    content[WORKER] = _service_worker(content)
    return Site(_write(folder, content), sum(len(_as_sent(name, part)) for name, part in content.items()))


def _page_files() -> list[Path]:
    return sorted(path for path in PAGE.rglob("*") if path.is_file())


def _third_party() -> dict[str, bytes]:
    """The files of third parties by their path in the page, WebAssembly packed, and the list of their licences."""
    found = {}
    for name, content in third_party_files().items():
        packed = name.endswith(".wasm")
        found[f"lib/{name}{PACKED_SUFFIX if packed else ''}"] = _packed(content) if packed else content
    licences = [
        {"name": package.name, "version": package.version, "licence": package.licence} for package in pinned_packages()
    ]
    found[LICENCES] = (json.dumps(licences, indent=1) + "\n").encode()
    return found


def _service_worker(content: Mapping[str, bytes]) -> bytes:
    """The service worker for this content, which keeps all but packed files from the start."""
    names = ["./", *sorted(name for name in content if not name.endswith((PACKED_SUFFIX, WORKER, ".d.ts")))]
    text = content[WORKER].decode().replace(VERSION_MARK, _version(content))
    return text.replace(FILES_MARK, f"FILES = {json.dumps(names)}").encode()


def _version(content: Mapping[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name in sorted(content):
        digest.update(name.encode() + b"\0" + hashlib.sha256(content[name]).digest())
    return digest.hexdigest()[:VERSION_LENGTH]


def _packed(content: bytes) -> bytes:
    return gzip.compress(content, COMPRESSION, mtime=0)


def _as_sent(name: str, content: bytes) -> bytes:
    return _packed(content) if name.endswith(TEXT_SUFFIXES) else content


def _write(folder: Path, content: Mapping[str, bytes]) -> list[Path]:
    paths = [folder / name for name in content]
    outputs().writes("", paths)
    for path, part in zip(paths, content.values(), strict=True):
        make_folder(path.parent)
        with atomic_write(path) as temporary:
            temporary.write_bytes(part)
    return paths
