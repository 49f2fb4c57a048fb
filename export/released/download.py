"""The file of a released checkpoint: downloaded from the hub where its authors publish it, or from a local folder."""

import os
import re
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ...model.checkpoint import file_sha256
from ...runtime.errors import InputError, one_line
from ...runtime.inference.known_models import REVISION, KnownModel
from ...runtime.system.cache_folder import cache_folder
from ...runtime.system.files import make_folder
from ...runtime.system.progress import CALLBACK, Progress, ProgressCallback

SHA256, COMMIT = re.compile("[0-9a-f]{64}"), re.compile("[0-9a-f]{40}")
REMOVED = "it was removed; pull it again"
HIDDEN_DIGITS = 8  # of a hash in messages


def fetch_checkpoint(model: KnownModel, source: Path | None = None, revision: str | None = None) -> Path:
    """The path of a released checkpoint whose SHA-256 was checked.

    source: a folder that has the file, or the file, instead of a download. revision: a commit or branch of the
    repository. A download goes to the cache folder, continues where an earlier one ended, and is not repeated.
    Raises InputError if the file cannot be had, or is not the released one.
    """
    if source is not None:
        path = source / model.file if source.is_dir() else source
        if not path.is_file():
            raise InputError(f"{path}: no such file; give the folder that has {model.file}")
        _check(path, model.sha256_prefix, "copy it again")
        return path
    folder = cache_folder("downloads") / model.repository.replace("/", "--")
    path = _downloaded(folder, model.file, revision) or _download(model, revision or REVISION, folder)
    try:
        _check(path, model.sha256_prefix, REMOVED)
    except InputError:
        path.unlink()
        raise
    return path


def _downloaded(folder: Path, file: str, revision: str | None) -> Path | None:
    """An earlier download, of the commit if one is asked for."""
    return next((path for path in sorted(folder.glob(f"*/{file}")) if revision in (None, path.parent.name)), None)


def _check(path: Path, expected: str, remedy: str) -> None:
    """Raise InputError unless the file's SHA-256 begins with the expected digits, which may be none."""
    digest = file_sha256(path)
    if not digest.startswith(expected):
        raise InputError(
            f"{path}: its SHA-256 begins with {digest[:HIDDEN_DIGITS]}, expected {expected[:HIDDEN_DIGITS]}: it is "
            f"damaged, or not the released file; {remedy}"
        )


def _download(model: KnownModel, revision: str, folder: Path) -> Path:
    """Download a file to the folder of its commit; what an interrupted download left is continued."""
    if find_spec("huggingface_hub") is None:
        raise InputError(
            "downloading needs huggingface_hub, which is not installed; pip install 'idesplat[hub]', or give a folder "
            f"that has {model.file} as --from"
        )
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")  # read when it is imported
    from huggingface_hub import get_hf_file_metadata, hf_hub_url
    from huggingface_hub.file_download import http_get
    from huggingface_hub.utils import build_hf_headers

    endpoint = os.environ.get("HF_ENDPOINT") or None
    # The repositories are public: no token is sent.
    headers = build_hf_headers(token=False, library_name="idesplat", library_version=version("idesplat"))
    try:
        url = hf_hub_url(model.repository, model.file, revision=revision, endpoint=endpoint)
        stated = get_hf_file_metadata(url, token=False, headers=headers, endpoint=endpoint)
        commit = stated.commit_hash or ""
        if not COMMIT.fullmatch(commit):  # it names a folder
            raise ValueError("the server states no commit; is it a hub?")
        path = folder / commit / model.file
        # `hf_hub_download` would start again: since version 2 it keeps nothing of an interrupted download.
        part = make_folder(path.parent) / f"{model.file}.part"
        with part.open("ab") as file:
            http_get(
                stated.location,
                file,
                resume_size=file.tell(),
                headers=headers,
                expected_size=stated.size,
                displayed_filename=model.file,
                tqdm_class=_progress_bar(CALLBACK.get(), f"downloading {model.file}"),
            )
    except Exception as error:  # of the hub's library, of its HTTP library, of the system
        raise InputError(
            f"{model.file} cannot be downloaded from {endpoint or 'huggingface.co'}/{model.repository} at {revision} "
            f"({one_line(error)}); pull it again to resume, set HF_ENDPOINT to a mirror, or give a folder that has it "
            "as --from"
        ) from None
    try:
        # The hub states the SHA-256 of large files as their ETag.
        _check(part, stated.etag if stated.etag and SHA256.fullmatch(stated.etag) else "", REMOVED)
    except InputError:
        part.unlink()
        raise
    return part.replace(path)


def _progress_bar(callback: ProgressCallback | None, description: str) -> Any:
    """A class in the place of tqdm's that reports to the callback, whatever thread it is used in."""

    class Bar:
        def __init__(self, *, total: float | None = None, initial: float = 0, **options: Any) -> None:
            self.total, self.n = total, initial
            self._report()

        def __enter__(self) -> Self:
            return self

        def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
        ) -> None:
            self.close()

        def update(self, count: float | None = 1) -> None:
            self.n += count or 0
            self._report()

        def close(self) -> None:
            self._report(ended=True)

        def _report(self, ended: bool = False) -> None:
            if callback is not None:
                total = None if self.total is None else int(self.total)
                callback(Progress(description, int(self.n), total, ended))

        def __getattr__(self, name: str) -> Any:  # what else tqdm has changes the display alone
            return lambda *args, **options: None

    return Bar
