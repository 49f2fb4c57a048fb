"""Pages that MkDocs builds from other sources: the command reference, the model card and the changelog."""

from pathlib import Path
from typing import Any

import typer
from idesplat.runtime.cli.application import COMMANDS, app
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
COPIED = {"model-card.md": "MODEL_CARD.md", "changelog.md": "CHANGELOG.md"}
INTRODUCTION = """# Commands

Every command takes `-h` or `--help`, and every option of a command may stand in a file given as `--config FILE`.
This page is generated from the commands themselves.

`idesplat-infer` and `idesplat-export` are other names of `idesplat infer` and `idesplat export`.

"""


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    files.append(File.generated(config, "commands.md", content=command_reference()))
    for page, source in COPIED.items():
        text = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
        for other_page, other_source in COPIED.items():
            text = text.replace(f"]({other_source})", f"]({other_page})")
        files.append(File.generated(config, page, content=text))
    return files


def command_reference() -> str:
    """The page of all commands and their options, in Markdown."""
    group = typer.main.get_command(app)
    sections = []
    with group.make_context("idesplat", ["--help"], resilient_parsing=True) as context:
        for name in COMMANDS:
            _, command, _ = group.resolve_command(context, [name])
            sections.append(_section(command, f"idesplat {name}", context))
    return INTRODUCTION + "\n".join(sections)


def _section(command: Any, path: str, parent: Any) -> str:
    """One command, and its sub-commands after it."""
    with command.make_context(path, [], parent=parent, resilient_parsing=True) as context:
        lines = [f"## {path}", "", (command.help or "").partition("\f")[0].strip(), ""]
        pieces = " ".join(command.collect_usage_pieces(context))
        lines += ["```", f"{path} {pieces}", "```", ""]
        rows = [_row(parameter, context) for parameter in command.params if not getattr(parameter, "hidden", False)]
        rows = [row for row in rows if row]
        if rows:
            lines += ["| option | |", "|---|---|", *rows, ""]
        for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
            lines.append(_section(command.get_command(context, name), f"{path} {name}", context))
    return "\n".join(lines)


def _row(parameter: Any, context: Any) -> str | None:
    """One option or argument as a row of a table; None where help does not show it."""
    record = parameter.get_help_record(context)
    if record is None:
        return None
    name, text = (" ".join(cell.split()).replace("|", "\\|") for cell in record)
    return f"| `{name}` | {text} |"
