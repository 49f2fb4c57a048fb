"""A released model by name, as a graph in the cache: the library behind `idesplat pull`."""

from importlib.metadata import version
from pathlib import Path

from ...runtime.inference.known_models import known_model
from ...runtime.inference.model_files import read_model
from ...runtime.inference.named_models import BUNDLED, cached_path, find_model
from ...runtime.system.files import make_folder
from ..pipeline import export_checkpoint, require_pytorch


def pull_model(name: str, source: Path | None = None, revision: str | None = None) -> Path:
    """The graph of a released model; downloaded, checked and exported unless this version has done it before.

    source, revision: as for `download.fetch_checkpoint`; with either of them the model is exported again.
    Raises InputError for an unknown name, where PyTorch is missing, or the file cannot be had; MismatchError where the
    graph does not compute what the network does.
    """
    if name == BUNDLED:
        return find_model(name)
    model = known_model(name)
    path = cached_path(name)
    if is_cached(name, source, revision):
        return path
    require_pytorch()
    from .download import fetch_checkpoint

    checkpoint = fetch_checkpoint(model, source, revision)
    make_folder(path.parent)
    export_checkpoint(checkpoint, path, preset=name, overwrite=True)
    return path


def is_cached(name: str, source: Path | None = None, revision: str | None = None) -> bool:
    """Whether the cache has a graph that this version exported, and no checkpoint of the caller's choice is wanted."""
    path = cached_path(name)
    return (
        source is None
        and revision is None
        and path.is_file()
        and read_model(path).metadata.version == version("idesplat")
    )
