"""The command `idesplat`: a group whose sub-commands are imported when they run, not when they are listed."""

from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from .terminal import HELP_OPTIONS, as_application, say


class SubCommand(NamedTuple):
    """Where a sub-command is defined, and the line that lists it.

    module: relative to this package. attribute: a function with typer's parameters, or a `typer.Typer`.
    """

    module: str
    attribute: str
    summary: str


COMMANDS = {
    "infer": SubCommand(".infer", "infer", "Photographs to a 3D Gaussian splat, depth maps and rendered views."),
    "batch": SubCommand(".batch", "batch", "Many scenes to splats, on this machine."),
    "serve": SubCommand(".serve", "serve", "Reconstruct scenes for clients over HTTP, with a page to try it."),
    "export": SubCommand("...export.cli", "export", "A checkpoint to ONNX, verified against PyTorch."),
    "models": SubCommand(".models", "models", "List the models that --model takes by name."),
    "pull": SubCommand("...export.released.cli", "pull", "Download a released model, and export it into the cache."),
    "view": SubCommand(".view", "view", "Look at a splat file in the browser."),
    "web": SubCommand(".web", "web", "Write a page that makes splats in the browser, for any static host."),
    "render": SubCommand(".render", "render", "A splat file to images or a video."),
    "refine": SubCommand(".refine", "refine", "Fit a splat file to the images of its scene."),
    "convert": SubCommand(".convert", "convert", "A splat file to another format."),
    "cameras": SubCommand(".cameras", "app", "Estimate cameras, or convert them between formats."),
    "eval": SubCommand("...tools.evaluation.cli", "app", "Novel-view and depth metrics of a model."),
    "bench": SubCommand("...tools.benchmark.cli", "bench", "Time and memory of models."),
    "train": SubCommand("...tools.training.cli", "train", "Train IDESplat on synthetic scenes or captures."),
}


class LazyGroup(TyperGroup):
    """The group of `COMMANDS`. Listing and completing them needs their names and summaries alone."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {name: TyperCommand(name, help=command.summary) for name, command in COMMANDS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The sub-command that the arguments name, loaded."""
        name, listed, rest = super().resolve_command(ctx, args)
        if listed is None or name is None:
            return name, listed, rest
        command = COMMANDS[name]
        found = getattr(import_module(command.module, __package__), command.attribute)
        return name, typer.main.get_command(as_application(found)), rest


app = typer.Typer(
    cls=LazyGroup,
    context_settings=HELP_OPTIONS,
    no_args_is_help=True,
    help="Feed-forward 3D Gaussian splatting: checkpoints to ONNX, photographs to splats.",
)


def _print_version(asked: bool) -> None:
    if asked:
        say(f"idesplat {version('idesplat')}")
        raise typer.Exit


@app.callback()
def _group(
    shown: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None: ...
