"""What one process does with scenes. It opens the model when the first scene needs it, and keeps it open."""

import logging
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from ..errors import InputError, one_line
from ..inference.model_files import ModelFiles, read_model
from ..inference.predictor import Predictor
from ..inference.providers import candidates
from ..inference.session import SessionConfig
from ..reconstruction.pipeline import reconstruct
from ..reconstruction.result import Reconstruction
from ..system.memory import peak_bytes, reset_peak
from ..system.outputs import outputs
from ..system.threads import limit_threads
from .cache import DEFAULT_GB, GB, InputCache
from .inputs import open_inputs
from .measures import measure, save_picture
from .places import Place, join
from .records import (
    PICTURE,
    PLY,
    RECORD,
    TRACEBACK,
    Status,
    check_own,
    files_of,
    fingerprint,
    is_done,
    model_sha256,
    read_record,
    splats_name,
    write_record,
    write_text,
)
from .results import Results, open_results
from .scenes import Scene, check_options, split_filters

LOG = logging.getLogger(__name__)

KILLED = "its worker process was killed twice, out of memory perhaps; use fewer workers, or fewer or smaller images"


@dataclass(frozen=True)
class Settings:
    """What all scenes of a run have in common.

    model_sha256: of `records.model_sha256`. out: the folder or URL that holds a folder of results for each scene.
    splat_format: a suffix without the dot. cache_bytes: of downloaded inputs to keep.
    """

    model: ModelFiles
    model_sha256: str
    provider: str
    session: SessionConfig
    options: Mapping[str, Any]
    out: Place
    splat_format: str = PLY
    retry_failed: bool = False
    overwrite: bool = False
    cache_bytes: int = int(DEFAULT_GB * GB)


def check_settings(options: Mapping[str, Any] | None, provider: str, splat_format: str, cache_gb: float) -> None:
    """Raise InputError for arguments of `make_settings` that are invalid, before a model is looked for."""
    check_options(options or {})
    candidates(provider)
    splats_name(splat_format)
    if not 0 <= cache_gb < float("inf"):
        raise InputError(f"--cache-size {cache_gb}: expected a number of gigabytes")


def make_settings(
    model: Path,
    out: Place,
    *,
    options: Mapping[str, Any] | None,
    splat_format: str,
    provider: str,
    session: SessionConfig,
    retry_failed: bool,
    cache_gb: float,
    overwrite: bool,
) -> Settings:
    """The settings that checked arguments of `batch` and `SceneReconstructor` give. model: its path.

    Raises InputError if the model cannot be read.
    """
    files = read_model(model)
    return Settings(
        files,
        model_sha256(files),
        provider,
        session,
        dict(options or {}),
        out,
        splat_format,
        retry_failed,
        overwrite,
        int(cache_gb * GB),
    )


class Outcome(NamedTuple):
    """The record of a scene, and whether it was tried in this run."""

    record: dict[str, Any]
    tried: bool


def start_worker(settings: Settings, threads: int) -> "Worker":
    """Prepare this process for a worker that takes so many threads."""
    limit_threads(threads)
    cv2.setNumThreads(threads)
    return Worker(settings)


def record_killed(scene: Scene, settings: Settings) -> Outcome:
    """The failure of a scene whose worker was killed twice; written down where the disk or the store takes it.

    What the worker had written by then is removed; older results stay, if it had not begun to replace them, and the
    record names their files.
    """
    place = join(settings.out, scene.id)
    record: dict[str, Any] = {"id": scene.id, "status": Status.FAILED, "error": KILLED, "hash": None, "seconds": None}
    try:
        results = open_results(place)
        before = read_record(results) or {}
        record |= {"hash": before.get("hash"), "files": files_of(before)}
        _remove_partial(results, before, settings)
        if isinstance(place, Path):
            outputs().writes("", [place / RECORD], known=True)
        write_record(results, record)
    except (InputError, OSError) as error:
        LOG.warning("%s", error)
    return Outcome(record, True)


def _remove_partial(results: Results, record: Mapping[str, Any], settings: Settings) -> None:
    """Remove what was written of a scene whose record says that its results are being replaced."""
    if record.get("status") == Status.WRITING:
        for name in (splats_name(settings.splat_format), PICTURE):
            results.remove(name)


@dataclass
class Worker:
    """Reconstructs scenes one after the other with one opened model."""

    settings: Settings
    _predictor: Predictor | None = field(default=None, init=False)

    def run(self, scene: Scene) -> Outcome:
        """Reconstruct a scene into its results, unless the record there says that it is done or has failed.

        A failure is returned as a record, and is written down where the disk or the store takes it.
        Raises InputError if the model cannot be opened.
        """
        started = time.perf_counter()
        made_from: str | None = None
        before: dict[str, Any] = {}
        reset_peak()
        try:
            results = open_results(join(self.settings.out, scene.id))
            results.tidy()
            before = read_record(results) or {}
            _remove_partial(results, before, self.settings)
            inputs = open_inputs(scene, InputCache(self.settings.cache_bytes))
            made_from = self._fingerprint(scene, inputs.hashes())
            if is_done(results, before, made_from) or self._stays_failed(before, made_from):
                return Outcome(before, False)
            if not self.settings.overwrite:
                check_own(results, join(self.settings.out, scene.id), splats_name(self.settings.splat_format))
        except Exception as error:
            if self._stays_failed(before, made_from):
                return Outcome(before, False)
            return Outcome(self._fail(scene, made_from, error, started), True)
        predictor = self._open()
        try:
            about, older = {"id": scene.id, "hash": made_from}, files_of(before)
            # A killed worker leaves what it worked on. Older results stay until there is something to replace them.
            write_record(results, {**about, "status": Status.STARTED, "files": older})
            with inputs.local() as local:
                result = self._reconstruct(local, predictor)
            # No record of other splats may stand beside new ones.
            write_record(results, {**about, "status": Status.WRITING})
            for name in {*older, splats_name(self.settings.splat_format)}:
                results.remove(name)
            record = about | self._write(result, results)
            results.remove(TRACEBACK)
            record |= {"seconds": time.perf_counter() - started, "peak_memory": peak_bytes()}
            write_record(results, record)
        except Exception as error:  # one scene's failure must not end the others
            with suppress(InputError, OSError):
                _remove_partial(results, read_record(results) or {}, self.settings)
            record = self._fail(scene, made_from, error, started)
        return Outcome(record, True)

    def _fingerprint(self, scene: Scene, inputs: Any) -> str:
        settings = self.settings
        options = {**settings.options, **scene.options}
        providers = ",".join(provider.name for provider in candidates(settings.provider))
        return fingerprint(scene, inputs, options, settings.model_sha256, providers, settings.splat_format)

    def _stays_failed(self, before: Mapping[str, Any], made_from: str | None) -> bool:
        failed = before.get("status") == Status.FAILED and before.get("hash") == made_from
        return failed and not self.settings.retry_failed

    def _open(self) -> Predictor:
        if self._predictor is None:
            self._predictor = Predictor(self.settings.model, self.settings.provider, self.settings.session)
        return self._predictor

    def _reconstruct(self, scene: Scene, predictor: Predictor) -> Reconstruction:
        filters, options = split_filters({**self.settings.options, **scene.options})
        return reconstruct(scene.images, scene.cameras, model=predictor, filters=filters, **options)

    def _write(self, result: Reconstruction, results: Results) -> dict[str, Any]:
        """Write the splats and the picture; what the record says of them."""
        finished = time.perf_counter()
        splats = splats_name(self.settings.splat_format)
        with results.writing(splats) as temporary:
            lost = result.save(temporary)
        written = time.perf_counter()
        psnr, picture = measure(result)
        with results.writing(PICTURE) as temporary:
            save_picture(temporary, picture)
        measured = time.perf_counter()
        return {
            "status": Status.DONE,
            "version": version("idesplat"),
            "files": {name: results.describe(name) for name in (splats, PICTURE)},
            "gaussians": 0 if result.gaussians is None else len(result.gaussians),
            "views": result.views.names,
            "psnr": psnr,
            "notes": [*result.notes, *lost],
            "timings": {**result.timings, "write": written - finished, "measure": measured - written},
        }

    def _fail(self, scene: Scene, made_from: str | None, error: Exception, started: float) -> dict[str, Any]:
        """The record of a failure; written, but for a disk that is full or the like, and then the scene is not done."""
        line = one_line(error)
        line = line if isinstance(error, InputError) else f"{type(error).__name__}: {line}"
        seconds = time.perf_counter() - started
        record: dict[str, Any] = {
            "id": scene.id,
            "status": Status.FAILED,
            "error": line,
            "hash": made_from,
            "seconds": seconds,
        }
        with suppress(InputError, OSError):
            results = open_results(join(self.settings.out, scene.id))
            if not self.settings.overwrite:
                check_own(results, scene.id, splats_name(self.settings.splat_format))
            record["files"] = files_of(read_record(results) or {})  # older results, which stay
            write_text(results, TRACEBACK, "".join(traceback.format_exception(error)))
            write_record(results, record)
        return record
