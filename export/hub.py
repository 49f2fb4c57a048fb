"""The folder that model hubs expect: graphs in `onnx/`, `config.json`, a model card, and checksums."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from ..runtime.inference.metadata import ModelMetadata
from ..runtime.system.files import atomic_write

GRAPHS = "onnx"
CONFIG, CARD, CHECKSUMS = "config.json", "README.md", "SHA256SUMS"
# The names of transformers.js: what follows `model`, by precision.
SUFFIXES = {"float32": "", "fp16": "_fp16", "int8": "_int8", "int8-qdq": "_int8_qdq"}


def graph_path(folder: Path, precision: str, target: str) -> Path:
    """The place of a graph in the folder; graphs for other targets than CPUs have the target in their name."""
    suffix = SUFFIXES[precision] + ("" if target == "cpu" else f"_{target}")
    return folder / GRAPHS / f"model{suffix}.onnx"


def hub_files(folder: Path) -> list[Path]:
    """The files that `write_hub_files` writes."""
    return [folder / name for name in (CONFIG, CARD, CHECKSUMS)]


def write_hub_files(folder: Path, metadata: ModelMetadata, verified: bool) -> list[Path]:
    """Write configuration, model card and checksums beside the graphs that the folder holds; the paths written."""
    graphs = sorted(path for path in (folder / GRAPHS).iterdir() if path.is_file() and not path.name.startswith("."))
    digests = {f"{GRAPHS}/{path.name}": _sha256(path) for path in graphs}
    config = {"model_type": "idesplat", "library_name": "idesplat"} | asdict(metadata)
    config |= {"graphs": sorted(name for name in digests if name.endswith(".onnx"))}
    templates = Environment(
        loader=PackageLoader("idesplat.export", "templates"), undefined=StrictUndefined, keep_trailing_newline=True
    )
    card = templates.get_template("model_card.md").render(metadata=metadata, digests=digests, verified=verified)
    texts = {
        CONFIG: json.dumps(config, indent=2) + "\n",
        CARD: card,
        CHECKSUMS: "".join(f"{digest}  {name}\n" for name, digest in digests.items()),
    }
    for path in hub_files(folder):
        with atomic_write(path) as temporary:
            temporary.write_text(texts[path.name], encoding="utf-8")
    return hub_files(folder)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
