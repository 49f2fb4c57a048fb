"""The command `idesplat pull`: a released model by name, downloaded and exported into the cache."""

from pathlib import Path
from typing import Annotated

import typer

from ...runtime.cli.options import Config, Quiet, Verbose
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say, warn

MISMATCH = 1  # exit status, as of `idesplat export`


@command("idesplat pull")
def pull(
    name: Annotated[str, typer.Argument(help="A model that `idesplat models` lists.", show_default=False)],
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Folder that has the released file, instead of a download.", show_default=False),
    ] = None,
    revision: Annotated[
        str | None,
        typer.Option(help="Commit or branch of the authors' repository; else its main branch.", show_default=False),
    ] = None,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Download a released model from its authors' repository, check its hash, and export it into the cache.

    HF_ENDPOINT names a mirror of the hub. A download that was interrupted goes on where it ended.
    """
    from ...runtime.inference.known_models import KNOWN_MODELS
    from ..pipeline import MismatchError
    from .pull import is_cached, pull_model

    before = name in KNOWN_MODELS and is_cached(name, source, revision)
    try:
        path = pull_model(name, source, revision)
    except MismatchError as error:
        warn(f"error: {error}")
        raise SystemExit(MISMATCH) from None
    model = KNOWN_MODELS.get(name)
    if model is None:
        say(f"{name} is bundled: {path}")
    else:
        say(f"{'is in the cache already:' if before else 'wrote'} {path}")
        say(f"licence: {model.licence}, as its authors state; https://huggingface.co/{model.repository}")
        if not model.sha256_prefix and not before:
            say("its name carries no hash: compared with the one that the hub states, where that is known")
    say(f"use it with: idesplat infer PHOTOS --model {name}")


def main() -> None:
    """Run the command."""
    run(pull)
