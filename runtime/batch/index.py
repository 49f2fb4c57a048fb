"""The page of a run's results: a picture of each scene, its quality, time and memory, and the errors of failed ones."""

from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from .records import PICTURE, TRACEBACK, Status, files_of

TEMPLATES = Path(__file__).with_name("templates")
TEMPLATE = "index.html.jinja"
MAX_SHOWN = 10_000  # scenes of either kind; more would be too much for a browser
MB = 10**6


class Shown(NamedTuple):
    """What the page says of a scene, as text. folder: its name in a URL. picture, splats: names of files, or empty."""

    id: str
    folder: str
    picture: str
    splats: str
    facts: str
    error: str


class Index:
    """The scenes of a run, as they come."""

    def __init__(self) -> None:
        self._done: list[Shown] = []
        self._failed: list[Shown] = []
        self._left_out = 0

    def add(self, record: dict[str, Any]) -> None:
        """Add the record of a scene that is done or has failed."""
        shown = self._done if record["status"] == Status.DONE else self._failed
        if len(shown) < MAX_SHOWN:
            shown.append(_shown(record))
        else:
            self._left_out += 1

    def page(self, counts: str) -> str:
        """The page. counts: of the scenes, in words."""
        from jinja2 import Environment, FileSystemLoader, StrictUndefined

        environment = Environment(
            loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
        )
        return environment.get_template(TEMPLATE).render(
            counts=counts,
            left_out=self._left_out,
            failed=sorted(self._failed),
            done=sorted(self._done),
            traceback=TRACEBACK,
        )


def _shown(record: dict[str, Any]) -> Shown:
    names = files_of(record)
    splats = next((name for name in names if name != PICTURE), "")
    facts = []
    if record.get("psnr") is not None:
        facts.append(f"PSNR {record['psnr']:.1f} dB")
    if record.get("gaussians"):
        facts.append(f"{record['gaussians']:,} Gaussians")
    if record.get("views"):
        facts.append(f"{len(record['views'])} views")
    if record.get("seconds") is not None:
        facts.append(f"{record['seconds']:.1f} s")
    if record.get("peak_memory") is not None:
        facts.append(f"{record['peak_memory'] / MB:,.0f} MB")
    picture = PICTURE if PICTURE in names else ""
    return Shown(record["id"], quote(record["id"]), picture, splats, " · ".join(facts), record.get("error") or "")
