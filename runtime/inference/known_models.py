"""The released models that can be fetched by name: what each is, and where its authors publish the checkpoint.

The names are those of the presets. A file's name may end in the first digits of its SHA-256, which fixes its content.
"""

import re
from dataclasses import dataclass

from ..errors import InputError

NAMED_HASH = re.compile(r"-([0-9a-f]{8})\.pth$")
DEPTHSPLAT, IDESPLAT = "haofeixu/depthsplat", "hflonglong/IDESplat"
# The branch of the repositories. Their commits could not be looked up: `--revision` takes one, and
# the hash in a file's name fixes what it must hold, whatever the commit.
REVISION = "main"


@dataclass(frozen=True)
class KnownModel:
    """A released model.

    parameters: millions. height, width: the trained size, pixels. views: the least and the greatest number in training.
    repository, file: where the checkpoint is, on the Hugging Face hub. gaussians: false if it predicts depth alone.
    """

    name: str
    family: str
    parameters: float
    height: int
    width: int
    views: tuple[int, int]
    repository: str
    file: str
    gaussians: bool = True
    licence: str = "MIT"

    @property
    def sha256_prefix(self) -> str:
        """The first digits of the file's SHA-256, as its name has them; empty if it has none."""
        named = NAMED_HASH.search(self.file)
        return named[1] if named else ""


def _depthsplat(preset: str, parameters: float, size: tuple[int, int], views: tuple[int, int], file: str) -> KnownModel:
    gaussians = file.startswith("depthsplat-gs-")
    return KnownModel(preset, "DepthSplat", parameters, *size, views, DEPTHSPLAT, file, gaussians)


def _idesplat(preset: str, size: tuple[int, int], views: tuple[int, int], file: str) -> KnownModel:
    return KnownModel(preset, "IDESplat", 37.1, *size, views, IDESPLAT, file)


_SMALL, _WIDE, _LARGE, _DEPTH = (256, 256), (256, 448), (448, 768), (352, 640)

KNOWN_MODELS = {
    model.name: model
    for model in (
        _idesplat("idesplat-re10k", _SMALL, (2, 2), "idesplat-re10k-256x256-view2.ckpt"),
        _idesplat("idesplat-acid", _SMALL, (2, 2), "idesplat-acid-256x256-view2.ckpt"),
        _idesplat("idesplat-dl3dv", _WIDE, (2, 6), "idesplat-dl3dv-256x448-randview2-6.ckpt"),
        _depthsplat(
            *("depthsplat-small-re10k", 38.3, _SMALL, (2, 2)), "depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth"
        ),
        _depthsplat(
            *("depthsplat-base-re10k", 120.7, _SMALL, (2, 2)), "depthsplat-gs-base-re10k-256x256-view2-ca7b6795.pth"
        ),
        _depthsplat(
            *("depthsplat-large-re10k", 354.3, _SMALL, (2, 2)), "depthsplat-gs-large-re10k-256x256-view2-e0f0f27a.pth"
        ),
        _depthsplat(
            *("depthsplat-base-re10k-256x448", 120.9, _WIDE, (2, 2)),
            "depthsplat-gs-base-re10k-256x448-view2-fea94f65.pth",
        ),
        _depthsplat(
            *("depthsplat-base-dl3dv", 120.9, _WIDE, (2, 6)),
            "depthsplat-gs-base-dl3dv-256x448-randview2-6-02c7b19d.pth",
        ),
        _depthsplat(
            *("depthsplat-small-re10kdl3dv", 38.4, _LARGE, (4, 10)),
            "depthsplat-gs-small-re10kdl3dv-448x768-randview4-10-c08188db.pth",
        ),
        _depthsplat(
            *("depthsplat-base-re10kdl3dv", 120.9, _LARGE, (2, 6)),
            "depthsplat-gs-base-re10kdl3dv-448x768-randview2-6-f8ddd845.pth",
        ),
        _depthsplat(
            *("depthsplat-depth-small", 35.5, _DEPTH, (2, 8)), "depthsplat-depth-small-352x640-randview2-8-e807bd82.pth"
        ),
        _depthsplat(
            *("depthsplat-depth-base", 111.2, _DEPTH, (2, 8)), "depthsplat-depth-base-352x640-randview2-8-65a892c5.pth"
        ),
    )
}


def known_model(name: str) -> KnownModel:
    """The released model of this name; raises InputError that lists the names."""
    if name not in KNOWN_MODELS:
        raise InputError(f"{name}: no model of this name is known; choose one of {', '.join(KNOWN_MODELS)}")
    return KNOWN_MODELS[name]
