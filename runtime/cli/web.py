"""The command `idesplat web`: a page that reconstructs in the browser, as a folder for any static host."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from ..errors import Terminated
from .options import Config, Model, Overwrite, Port, Quiet, Size, Verbose
from .outputs import command
from .terminal import run, say

LOOPBACK = "127.0.0.1"
PORT = 8000


@command("idesplat web")
def web(
    folder: Annotated[Path, typer.Argument(help="Folder to write the page into.", show_default=False)],
    model: Model = None,
    size: Size = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve the page on this machine, too.")] = False,
    port: Port = PORT,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Write a page that makes splats of images in the browser: a folder for any static host.

    The page works offline once it was open, and uploads nothing. It takes two views of one size, 256x256 by default.
    """
    from ..images.sizes import parse_size
    from ..inference.model_files import read_model
    from ..inference.named_models import find_model
    from ..web.site import write_site

    files = read_model(find_model(model))
    site = write_site(folder, files, parse_size(size) if size else None)
    say(f"wrote {len(site.files)} files to {folder}, {site.download / 1e6:.1f} MB to download")
    if serve:
        _serve(folder, port)
    else:
        chosen = [*(["--model", str(model)] if model else []), *(["--size", size] if size else [])]
        again = shlex.join(["idesplat", "web", str(folder), *chosen, "--serve"])
        say(f"put the folder on any static host, or look at it here: {again}")


def _serve(folder: Path, port: int) -> None:
    from ..viewer.server import address, free_port
    from ..web.serving import page_server

    with page_server(folder, LOOPBACK, free_port(LOOPBACK, port)) as server:
        say(f"the page: {address(LOOPBACK, server.server_address[1])} (stop with Ctrl-C)")
        try:
            server.serve_forever()
        except Terminated:
            raise
        except KeyboardInterrupt:  # ends this command, as it should
            return


def main() -> None:
    """Run the command."""
    run(web)
