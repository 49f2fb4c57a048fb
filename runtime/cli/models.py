"""The command `idesplat models`: the models that `--model` takes by name."""

from typing import TYPE_CHECKING, Any

from .options import Config, Json, Overwrite, Quiet, Verbose
from .outputs import STANDARD_OUTPUT, command, outputs, write_json
from .reporting import note
from .terminal import literal, run, say

if TYPE_CHECKING:
    from ..inference.known_models import KnownModel

WIDTH = 150  # columns, if the output is not a terminal
BUNDLED_STATE, CACHED, KNOWN = "bundled", "cached", "known"
BUNDLED_MILLIONS = 3.0  # parameters, which the metadata does not tell


@command("idesplat models")
def models(
    json_path: Json = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """List the models that --model takes by name: bundled, cached, and known ones to be fetched by `idesplat pull`."""
    import json

    from ..inference.known_models import KNOWN_MODELS

    if json_path is not None and json_path != STANDARD_OUTPUT:
        outputs().writes("--json", [json_path])
    rows = [_bundled(), *(_released(model) for model in KNOWN_MODELS.values())]
    if json_path is not None:
        write_json(json_path, json.dumps(rows, indent=2))
        if json_path == STANDARD_OUTPUT:
            return
        say(f"wrote {json_path}")
    _print(rows)
    note("use one with --model NAME; fetch a known one with: idesplat pull NAME")


def main() -> None:
    """Run the command."""
    run(models)


def _bundled() -> dict[str, Any]:
    """What the bundled model is, from its metadata."""
    from ..inference.bundled_model import bundled_model
    from ..inference.model_files import read_model
    from ..inference.named_models import BUNDLED

    path = bundled_model()
    own = read_model(path).metadata
    return {
        "name": BUNDLED,
        "family": "IDESplat",
        "parameters_million": BUNDLED_MILLIONS,
        "size": [own.height, own.width],
        "views": own.trained_views,
        "gaussians": own.gaussians,
        "licence": "MIT AND Apache-2.0",
        "state": BUNDLED_STATE,
        "path": str(path),
    }


def _released(model: "KnownModel") -> dict[str, Any]:
    """What a released model is, and whether it is in the cache."""
    from ..inference.named_models import cached_path

    path = cached_path(model.name)
    cached = path.is_file()
    return {
        "name": model.name,
        "family": model.family,
        "parameters_million": model.parameters,
        "size": [model.height, model.width],
        "views": list(model.views),
        "gaussians": model.gaussians,
        "licence": model.licence,
        "state": CACHED if cached else KNOWN,
        "path": str(path) if cached else None,
        "repository": model.repository,
        "file": model.file,
    }


def _print(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for name in ("name", "family", "parameters", "trained at", "views", "predicts", "licence", "state"):
        table.add_column(name, no_wrap=True)
    for row in rows:
        height, width = row["size"]
        least, most = row["views"]
        cells = (
            *(row["name"], row["family"], f"{row['parameters_million']:.1f} M", f"{height}x{width}"),
            *(f"{least} to {most}" if least < most else str(least), "Gaussians" if row["gaussians"] else "depth"),
            *(row["licence"], row["state"]),
        )
        table.add_row(*map(literal, cells))
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)
