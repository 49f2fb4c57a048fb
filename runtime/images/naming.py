"""Names of files that are made of images."""

import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

from ..system.files import without_case
from .finding import image_stem

UNNAMED = "image"  # for a file whose image has no name


def name_files(images: Sequence[str], endings: Sequence[str] = ("",)) -> list[str]:
    """File names, without ending, for what is made of images: theirs without folder and suffix where these differ.

    Else the folders stand in front (left-0001, right-0001), and where that is not enough every image's number. No two
    of the names differ in case alone, and none is another one with an ending, so that `a` with the ending `-depth` and
    `a-depth` are told apart.
    """
    paths = [PurePosixPath(image.replace("\\", "/")) for image in images]
    stems = [image_stem(path) or UNNAMED for path in paths]
    if _distinct(stems, endings):
        return stems
    levels = zip(*(path.parts[:-1] for path in paths), strict=False)
    common = len(list(itertools.takewhile(lambda level: len(set(level)) == 1, levels)))
    nested = [
        "-".join([*(part for part in path.parts[common:-1] if part not in ("/", "..")), name])
        for path, name in zip(paths, stems, strict=True)
    ]
    if _distinct(nested, endings):
        return nested
    digits = len(str(len(stems) - 1))
    return [f"{index:0{digits}}-{name}" for index, name in enumerate(stems)]


def _distinct(names: Sequence[str], endings: Sequence[str]) -> bool:
    counts = Counter(without_case(name + ending) for name in names for ending in endings)
    return all(count == 1 for count in counts.values())
