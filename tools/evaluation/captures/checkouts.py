"""Files of public git repositories at pinned commits, from existing checkouts or clones made on demand."""

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ....runtime.errors import InputError
from ....runtime.system.cache_folder import cache_folder
from ....runtime.system.files import make_folder, scratch_folder
from .capture import Capture

CLONES = "captures"  # in idesplat's cache folder
HOST = "https://github.com"
GIT_FOLDER = ".git"


def clones_folder() -> Path:
    """The default folder for clones, in idesplat's cache folder; raises InputError if the user has no home folder."""
    try:
        return cache_folder(CLONES)
    except RuntimeError as error:
        raise InputError(f"no folder for clones ({error}); give --checkouts") from None


def find_checkout(folder: Path, repository: str) -> Path | None:
    """The checkout of OWNER/NAME in a folder, named OWNER+NAME or OWNER/NAME: a work tree or a git directory."""
    for name in (repository.replace("/", "+"), repository, repository + ".git"):
        candidate = folder / name
        if (candidate / GIT_FOLDER).exists() or (candidate / "HEAD").is_file():
            return candidate
    return None


def fetch_checkout(folder: Path, repository: str, commit: str, host: str = HOST) -> Path:
    """The checkout of OWNER/NAME in a folder; a missing one is fetched from `host`.

    Existing checkouts are not changed. Git fetches the files of a fetched one when they are read (a partial clone).
    Raises InputError where git or the network fails, or an existing checkout lacks the commit.
    """
    found = find_checkout(folder, repository)
    if found is not None:
        _git(found, "cat-file", "-e", f"{commit}^{{commit}}")
        return found
    target = folder / repository.replace("/", "+")
    # A fetch that fails or is killed must not leave a folder that looks like a checkout.
    with scratch_folder(make_folder(folder)) as scratch:
        fetched = make_folder(scratch / target.name)
        _git(fetched, "init", "--quiet", "--bare")
        _git(fetched, "remote", "add", "origin", f"{host}/{repository}")
        _git(fetched, "fetch", "--quiet", "--depth=1", "--filter=blob:none", "origin", commit)
        return fetched.rename(target)


@contextmanager
def frames_of(checkouts: Path, capture: Capture) -> Iterator[Path]:
    """A folder with a capture's frames, for the block. checkouts: the folder of checkouts; raises InputError."""
    checkout = fetch_checkout(checkouts, capture.repository, capture.commit)
    with scratch_folder() as folder:
        extract(checkout, capture.commit, capture.folder, capture.frames, folder)
        yield folder


def extract(checkout: Path, commit: str, folder: str, names: Sequence[str], into: Path) -> None:
    """Write files of a folder of the commit into another folder under the same names; raises InputError.

    The commit is read, not the work tree, so local changes have no effect.
    """
    for name in names:
        content = _git(checkout, "cat-file", "blob", f"{commit}:{folder and folder + '/'}{name}")
        path = into / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def list_folder(checkout: Path, commit: str, folder: str) -> list[str]:
    """The names of the files in a folder of the commit; none if there is no such folder. Raises InputError."""
    entries = _git(checkout, "ls-tree", "-z", commit, f"{folder}/").decode(errors="replace").split("\0")
    rows = [entry.split("\t") for entry in entries if entry]
    return [path.rpartition("/")[2] for meta, path in rows if meta.split()[1] == "blob"]


def _git(checkout: Path, *arguments: str) -> bytes:
    """Run git in the checkout; its standard output. Raises InputError with git's last line."""
    # No hook, pager or prompt of a foreign repository may run, and it may belong to another user.
    options = ("-c", "core.hooksPath=/dev/null", "-c", f"safe.directory={checkout.resolve()}")
    environment = {**os.environ, "GIT_TERMINAL_PROMPT": "0", "GIT_CEILING_DIRECTORIES": str(checkout.resolve().parent)}
    command = ["git", "-C", str(checkout), *options, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, env=environment)
    except FileNotFoundError:
        raise InputError("git is needed to read checkouts, and is not installed; install git") from None
    if done.returncode != 0:
        reason = (done.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        raise InputError(
            f"{checkout}: git {arguments[0]} failed ({reason}); expected the pinned commit and its files: "
            "remove the checkout to have it cloned, with network"
        )
    return done.stdout
