"""The command `idesplat serve`: a service that reconstructs scenes over HTTP."""

import ipaddress
import os
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..service.limits import GIB, MIB, TOKEN_VARIABLE, Limits
from .options import Config, Device, Host, Model, Port, Provider, ProviderOption, Quiet, Threads, Verbose
from .outputs import command
from .reporting import note
from .session_options import session_config
from .terminal import run, say

LOOPBACK = "127.0.0.1"
PORT = 8000
MAX_WORKERS = 64
LIMITS = "Limits"
DEFAULTS = Limits()


@command("idesplat serve")
def serve(
    *,
    model: Model = None,
    host: Host = LOOPBACK,
    port: Port = PORT,
    token: Annotated[
        str | None,
        typer.Option(
            help="What clients must send as `Authorization: Bearer TOKEN`. Better given as the environment variable: "
            "other users of the machine can read command lines.",
            envvar=TOKEN_VARIABLE,
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(help="Processes, each with an opened model and its share of cores.", min=1, max=MAX_WORKERS),
    ] = 1,
    storage: Annotated[
        Path | None,
        typer.Option(help="Folder for uploads and results; else the system's for temporary files.", show_default=False),
    ] = None,
    max_upload: Annotated[
        int, typer.Option(help="Megabytes of an upload, and of what a zip unpacks to.", min=1, rich_help_panel=LIMITS)
    ] = DEFAULTS.upload_bytes // MIB,
    max_images: Annotated[
        int, typer.Option(help="Images in an upload.", min=2, rich_help_panel=LIMITS)
    ] = DEFAULTS.images,
    max_megapixels: Annotated[
        int, typer.Option(help="Of an image.", min=1, max=256, rich_help_panel=LIMITS)
    ] = DEFAULTS.megapixels,
    max_views: Annotated[
        int, typer.Option(help="Images that a scene uses.", min=2, rich_help_panel=LIMITS)
    ] = DEFAULTS.views,
    max_size: Annotated[
        str,
        typer.Option(help="A scene may ask to work at as many pixels.", metavar="HEIGHTxWIDTH", rich_help_panel=LIMITS),
    ] = "{}x{}".format(*DEFAULTS.size),
    max_queue: Annotated[
        int, typer.Option(help="Scenes that wait; more are answered with 429.", min=1, rich_help_panel=LIMITS)
    ] = DEFAULTS.queue,
    max_seconds: Annotated[
        float, typer.Option(help="That a scene may run.", min=1, max=86400, rich_help_panel=LIMITS)
    ] = DEFAULTS.seconds,
    max_memory: Annotated[
        float | None,
        typer.Option(
            help="Gigabytes that a worker may take, on Linux; a scene that needs more fails.",
            min=0.5,
            show_default=False,
            rich_help_panel=LIMITS,
        ),
    ] = None,
    max_storage: Annotated[
        float,
        typer.Option(help="Gigabytes of all scenes; the oldest results go first.", min=0.001, rich_help_panel=LIMITS),
    ] = DEFAULTS.storage_bytes / GIB,
    keep: Annotated[
        float, typer.Option(help="Seconds that results stay.", min=1, max=31_536_000, rich_help_panel=LIMITS)
    ] = DEFAULTS.keep_seconds,
    stop_after: Annotated[
        float,
        typer.Option(
            help="Seconds that running scenes get after SIGTERM or Ctrl-C.", min=0, max=86400, rich_help_panel=LIMITS
        ),
    ] = DEFAULTS.stop_seconds,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Reconstruct scenes for clients over HTTP, with a page to try it.

    POST images to /v1/scenes; /openapi.json describes the rest. The first SIGTERM or Ctrl-C lets running scenes finish,
    the second ends them.
    """
    _check_access(host, token)
    try:
        from ..service.server import serve as run_service
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("idesplat"):
            raise
        raise InputError(
            f"{error.name} is not installed, which a service needs; pip install 'idesplat[serve]'"
        ) from None
    from ..images.sizes import parse_size
    from ..inference.model_files import read_model
    from ..inference.named_models import find_model
    from ..inference.providers import candidates
    from ..inference.session import usable_cores
    from ..service.service import Settings
    from ..service.worker import Setup

    session = session_config(threads, device, provider_option)
    candidates(provider)
    files = read_model(find_model(model))
    limits = Limits(
        upload_bytes=max_upload * MIB,
        images=max_images,
        megapixels=max_megapixels,
        views=max_views,
        size=parse_size(max_size),
        queue=max_queue,
        seconds=max_seconds,
        keep_seconds=keep,
        storage_bytes=int(max_storage * GIB),
        stop_seconds=stop_after,
        memory_bytes=None if max_memory is None else int(max_memory * GIB),
    )
    setup = Setup(
        str(files.path),
        provider,
        session.threads or max(1, usable_cores() // workers),
        session.device,
        dict(session.provider_options),
        limits.megapixels,
        limits.memory_bytes,
    )
    settings = Settings(files, setup, host, port, workers, token, limits)
    run_service(settings, storage, _tell)


def main() -> None:
    """Run the command."""
    run(serve)


def _check_access(host: str, token: str | None) -> None:
    """Raise InputError where a service would be open to others, or has a token that nobody can send."""
    if token is not None and not (token.isascii() and token.isprintable() and token.strip() == token and token):
        raise InputError("--token: expected characters of ASCII without spaces at the ends")
    if token is None and not _is_loopback(host):
        raise InputError(
            f"--host {host}: others can reach the service there; set the environment variable {TOKEN_VARIABLE}, or "
            "give --token"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _tell(address: str) -> None:
    say(f"serving at {address} (stop with Ctrl-C)")
    secret = f' -H "Authorization: Bearer ${TOKEN_VARIABLE}"' if os.environ.get(TOKEN_VARIABLE) else ""
    note(f"try it in a browser, or: curl{secret} -F images=@1.jpg -F images=@2.jpg {address}/v1/scenes")
