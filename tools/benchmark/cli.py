"""The command `idesplat bench`: time and memory of exported models, and where the time goes.

Candidates run interleaved, round by round, each in a process of its own, so transient load affects all of them equally.
Beside them run a large GEMM, whose rate is the roofline, and the same networks in eager PyTorch where it is installed.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ...runtime.cli.input_files import model_files
from ...runtime.cli.options import (
    EXECUTION,
    Config,
    Device,
    Json,
    Overwrite,
    ProviderOption,
    Providers,
    Quiet,
    Threads,
    Verbose,
)
from ...runtime.cli.outputs import STANDARD_OUTPUT, command
from ...runtime.cli.session_options import session_config
from ...runtime.cli.terminal import literal, run, say, warn
from ...runtime.errors import InputError, error_context
from ...runtime.images.sizes import parse_size
from ...runtime.system.limits import parse_whole_number
from ...runtime.system.outputs import outputs

if TYPE_CHECKING:  # nothing heavy is loaded before there is something to measure
    from .report import Row

REGRESSED = 1  # exit status where --compare finds a regression
INTERRUPTED = 130
MIN_VIEWS = 2
STEPS_OF_A_ROUND = 3  # of training


@command("idesplat bench")
def bench(
    models: Annotated[
        list[Path] | None, typer.Argument(help="Models (.onnx, staged folders or names) instead of the bundled one.")
    ] = None,
    views: Annotated[str, typer.Option(help="Numbers of views, such as 2,4.")] = "2",
    sizes: Annotated[
        str | None, typer.Option(help="Sizes, such as 256x256,256x448, instead of each model's own.")
    ] = None,
    provider: Providers = None,
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    list_providers: Annotated[
        bool,
        typer.Option(
            "--list-providers",
            help="List the execution providers, which are installed, and what was tried of each.",
            rich_help_panel=EXECUTION,
        ),
    ] = False,
    repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 7,
    eager: Annotated[bool, typer.Option(help="Run the same networks in eager PyTorch, where it is installed.")] = True,
    training: Annotated[
        bool, typer.Option("--training", help="Measure training instead: scenes per second of three configurations.")
    ] = False,
    json_path: Json = None,
    compare: Annotated[
        Path | None, typer.Option(help="An earlier --json file; exit with status 1 on a regression.")
    ] = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Measure time and memory of exported models, each in a fresh process; Ctrl-C keeps finished workloads.

    --provider may be repeated to compare several; CPU by default.
    """
    if list_providers:
        from .report import print_providers

        print_providers()
        return
    if training:
        _check_unused({"MODELS": models, "--sizes": sizes, "--json": json_path, "--compare": compare})
        from .training import benchmark_training, print_training

        with _status() as status:
            found = benchmark_training(repeats, STEPS_OF_A_ROUND, status)
        print_training(found)
        return
    from ...runtime.inference.named_models import find_model
    from .report import compare as compare_rows
    from .report import print_rows, read_rows, write_rows
    from .runner import benchmark, describe_machine, settings_for

    paths = [find_model(model) for model in models] if models else [find_model()]
    _check_json(json_path, [*paths, *([compare] if compare else [])])
    before = read_rows(compare) if compare is not None else []
    providers = provider or ["CPU"]
    if len(providers) > 1 and (device or provider_option):
        raise InputError("--device and --provider-option: expected one --provider, whose they are; got several")
    settings = settings_for(session_config(threads, device, provider_option), repeats, eager)
    counts, shapes = _counts(views), _sizes(sizes)
    rows: list[Row] = []
    interrupted = False
    try:
        with _status() as status:
            for measured in benchmark(
                paths,
                settings,
                view_counts=counts,
                sizes=shapes,
                providers=providers,
                on_status=status,
            ):
                rows += measured
    except KeyboardInterrupt:
        interrupted = True
    for row in rows:
        if row.problem:
            warn(f"{row.name}: {row.problem}")
    measured = [row for row in rows if row.seconds]
    if measured:
        print_rows(measured)
    if measured and json_path is not None:
        write_rows(json_path, describe_machine(settings), measured)
        if json_path != STANDARD_OUTPUT:
            say(f"wrote {json_path}")
    if interrupted:
        warn("interrupted: unfinished workloads are missing")
        raise SystemExit(INTERRUPTED)
    if not measured:
        raise InputError("nothing could be measured, for the reasons above")
    regressions: list[str] = []
    if compare is not None:
        with error_context(f"--compare {compare}"):
            regressions = compare_rows(rows, before)
    for line in regressions:
        warn(f"regression: {line}")
    if regressions:
        raise SystemExit(REGRESSED)


def main() -> None:
    """Run the command."""
    run(bench)


def _check_unused(given: dict[str, object]) -> None:
    """Raise InputError for the first argument that has a value, which a benchmark of training does not use."""
    for name, value in given.items():
        if value:
            raise InputError(
                f"--training and {name}: expected one of them; training is measured on networks of its own"
            )


def _check_json(json_path: Path | None, read: Sequence[Path]) -> None:
    """Check before measuring that the JSON can be written and is none of the files to read."""
    if json_path is None or json_path == STANDARD_OUTPUT:
        return
    for path in read:
        outputs().reads("a model or measurements", model_files(path))
    outputs().writes("--json", [json_path])


def _counts(text: str) -> list[int]:
    """The option --views, `2,4`, as numbers; raises InputError."""
    parts = text.split(",")
    if not all((parse_whole_number(part) or 0) >= MIN_VIEWS for part in parts):
        raise InputError(f"--views {text}: expected numbers from {MIN_VIEWS}, such as 2,4")
    return [int(part) for part in parts]


def _sizes(text: str | None) -> list[tuple[int, int]]:
    """The option --sizes, `256x256,256x448`, as heights and widths, none where it is not given; raises InputError."""
    return [parse_size(size) for size in text.split(",")] if text is not None else []


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    """Show what is being done, on stderr where that is a terminal."""
    with Console(stderr=True).status("starting") as status:
        yield lambda doing: status.update(literal(doing))


if __name__ == "__main__":
    main()
