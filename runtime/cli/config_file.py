"""The option --config: a TOML file that gives options of a command by their names."""

import tomllib
from pathlib import Path
from typing import Any

import typer

from ..errors import InputError
from ..system.files import read_bytes


def read_config(context: typer.Context, path: Path | None) -> Path | None:
    """Use the file's values as defaults of the command's options; typer calls this before it reads other options.

    Raises InputError for a file that is no TOML, an option that the command does not have, or a value of another kind.
    """
    if path is None or context.resilient_parsing:
        return path
    try:
        content = tomllib.loads(read_bytes(path, "a configuration").decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f'{path}: is no TOML ({error}); expected lines such as: size = "256x448"') from None
    known = _options(context)
    context.default_map = {}
    for name, value in content.items():
        option = known.get(name.replace("_", "-"))
        if option is None:
            raise InputError(f"{path}: {context.command_path} has no option {name}; it has {', '.join(sorted(known))}")
        context.default_map[option.name] = _value(path, name, value, option)
    return path


def _options(context: typer.Context) -> dict[str, Any]:
    """The command's options and arguments, by their long names without dashes."""
    found: dict[str, Any] = {}
    for parameter in context.command.params:
        if getattr(parameter, "hidden", False) or parameter.name in ("config", "help"):
            continue
        names = [name[2:] for name in parameter.opts if name.startswith("--")] or [parameter.name]
        found.update((name.replace("_", "-"), parameter) for name in names)
    return found


def _value(path: Path, name: str, value: Any, option: Any) -> Any:
    """The value as command-line strings, which typer converts to numbers and paths."""
    several = getattr(option, "multiple", False) or option.nargs == -1
    if getattr(option, "count", False) and isinstance(value, int) and not isinstance(value, bool):
        return value
    if getattr(option, "is_flag", False):
        expected, fits = "true or false", isinstance(value, bool)
    elif several:
        expected, fits = "a list of texts", isinstance(value, list) and all(isinstance(item, str) for item in value)
    else:
        expected, fits = "a text or a number", isinstance(value, (str, int, float)) and not isinstance(value, bool)
    if not fits:
        raise InputError(f"{path}: {name} is {value!r}, expected {expected}")
    return value if isinstance(value, (bool, list)) else str(value)
