"""What is done to good input to make it bad: mutated files, odd values in JSON, odd texts and odd paths.

IDESPLAT_FUZZ_EXAMPLES: how many examples of each target are tried, at random, instead of the few that are always the
same.
"""

import copy
import json
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

EXAMPLES = int(os.environ.get("IDESPLAT_FUZZ_EXAMPLES", "0"))
DEEP = "@nested without end@"  # stands for brackets that no writer of JSON would write
DEPTH = 20_000
SHOWN = 400  # bytes
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
HUGE = (0, 1, -1, 255, 2**15, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**62, 2**63 - 1, -(2**63))
FLOATS = (float("nan"), float("inf"), -float("inf"), -0.0, 1e30, 1e300, 5e-324)
TEXTS = (
    *("", " ", "-", "--", "0", "-0", "-1", "1.5", "1e400", "-1e400", "nan", "inf", "1e-400", "0x10", "1_000"),
    *("9" * 5000, "32x48"),
    *("\N{ARABIC-INDIC DIGIT THREE}", "\N{SUPERSCRIPT TWO}", "\N{SUPERSCRIPT TWO}x\N{SUPERSCRIPT TWO}", "1,1", "a,b"),
    *("0-", "0:0:0", "3:1:-1", "1-999999999999", "0:999999999999:1", "32x", "x", "32x48x3", "0x0", "99999999x99999999"),
    *("\x00", "a\x00b", "\udcff", "\ud800", "\x1b[2J\x07", "a\nb", "a\r\tb", "\N{RIGHT-TO-LEFT OVERRIDE}x", "%s{}[/]"),
    *("x" * 300, "x" * 3000, "\N{SNOWMAN}" * 90, "*", "[", "**/*"),
    *("~", "$HOME", "-o", "true", "null", "estimate", "auto"),
)
JSON_VALUES = (
    *(None, True, False, "", "x" * 10_000, "\x00", "\ud800", "\x1b[2J", "../../x", "/dev/zero", "NaN", "²", DEEP),
    *([], {}, [[]] * 1000, [0] * 5, {"a": {}}, 10**400, 0.5, *HUGE, *FLOATS),
)
SNIPPETS = (
    *(b"9", b"-", b"null", b"[", b"]", b"{}", b"1e999", b"NaN", b"Infinity", b'"x"'),
    *(b"\0", b"\n", b"\xff\xfe", b"%", b" "),
    *(b"\xff" * 4, b"\xff" * 8, b"\0" * 8, b"9" * 5000, b"[" * DEPTH, b'{"a":' * DEPTH, b"\x1b[2J", "²".encode()),
)


def tried(examples: int) -> settings:
    """The settings of a test with this many examples, unless the environment says how many."""
    return settings(
        max_examples=EXAMPLES or examples,
        derandomize=not EXAMPLES,
        phases=(Phase.explicit, Phase.generate) if EXAMPLES else tuple(Phase),
        database=None,
        suppress_health_check=list(HealthCheck),
    )


class Content(bytes):
    """What a file holds, of which a failing test prints no more than the beginning."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes: {bytes(self[:SHOWN])!r}>"


@st.composite
def mutated(draw: st.DrawFn, content: bytes) -> bytes:
    """The content of a file after one to four mutations."""
    result = bytearray(content)
    for kind in draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=4)):
        at = draw(st.integers(0, len(result)))
        if kind == "flip" and at < len(result):
            result[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del result[at:]
        elif kind == "delete":
            del result[at : at + draw(st.integers(1, 40))]
        elif kind == "bytes":
            new = draw(st.binary(min_size=1, max_size=12))
            result[at : at + draw(st.sampled_from([0, len(new)]))] = new
        elif kind == "snippet":
            new = draw(st.sampled_from(SNIPPETS))
            result[at : at + draw(st.sampled_from([0, len(new)]))] = new
        elif kind == "word":  # a number of a text
            found = NUMBER.search(result, at) or NUMBER.search(result)
            if found:
                result[found.start() : found.end()] = draw(st.sampled_from(SNIPPETS))
        elif kind == "number":
            new = struct.pack(*draw(st.sampled_from(PACKED)))
            result[at : at + len(new)] = new
        elif kind == "splice":
            start = draw(st.integers(0, len(result)))
            result[at:at] = result[start : start + draw(st.integers(1, 200))]
        elif kind == "repeat":
            result += result[:100_000]
    return Content(result)


KINDS = ("flip", "cut", "delete", "bytes", "snippet", "word", "number", "splice", "repeat")
PACKED = tuple(
    (order + ("q" if number < 0 else "Q") if abs(number) >= 2**31 else order + ("i" if number < 0 else "I"), number)
    for number in HUGE
    if number != -(2**31)
    for order in "<>"
) + tuple((order + kind, number) for number in (FLOATS[:4]) for kind in "fd" for order in "<>")


@st.composite
def mutated_json(draw: st.DrawFn, document: Any) -> bytes:
    """A JSON document of which one to three values were replaced, removed, wrapped or repeated."""
    document = [copy.deepcopy(document)]
    for _ in range(draw(st.integers(1, 3))):
        parent, key = draw(st.sampled_from(list(_places(document))))
        kind = draw(st.sampled_from(("replace", "replace", "replace", "remove", "wrap", "repeat")))
        if kind == "replace" or parent is document:
            parent[key] = copy.deepcopy(draw(st.sampled_from(JSON_VALUES)))
        elif kind == "remove":
            del parent[key]
        elif kind == "wrap":
            parent[key] = [parent[key]]
        elif isinstance(parent, list):
            parent += copy.deepcopy(parent)
    text = json.dumps(document[0]).replace(f'"{DEEP}"', "[" * DEPTH + "]" * DEPTH)
    return Content(text.encode())


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Where values stand in a document: the list or object that holds each, and its place there."""
    if isinstance(value, (dict, list)):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def make_odd_paths(folder: Path) -> list[str]:
    """Paths of what is no regular file, or has an awkward name, made in a folder."""
    os.mkfifo(folder / "pipe.json")
    os.mkfifo(folder / "pipe.ply")
    (folder / "loop.ply").symlink_to("loop.ply")
    (folder / "nowhere.ply").symlink_to("missing/too")
    (folder / "zero.onnx").symlink_to("/dev/zero")
    (folder / "empty.json").touch()
    (folder / "empty").mkdir()
    (folder / "\x1b[2J\n.json").write_text("{}")
    (folder / os.fsdecode(b"\xff\xfe.ply")).write_bytes(b"ply\n")
    names = [path.name for path in folder.iterdir()]
    return [*names, *ODD_PATHS, *(name + ending for name in ODD_NAMES for ending in ENDINGS)]


ODD_NAMES = (
    *("a" * 250, "a" * 300, "\N{SNOWMAN}" * 84, "b" * 5000),
    *("a\x00b", "\ud800", "\x1b[31m", "a\nb", "\N{RIGHT-TO-LEFT OVERRIDE}"),
)
ODD_PATHS = (
    *("", ".", "..", "/dev/zero", "/dev/full", "/dev/null", "/dev/stdin/x", "/proc/self/mem", "/nowhere/at/all.ply"),
    *("scene.ply/x.ply", "transforms.json/x.json", "missing/x.json", "missing/", "images/", "images/*", "./scene.ply"),
)
ENDINGS = ("", ".ply", ".json", ".png", ".onnx", ".html")
