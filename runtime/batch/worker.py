"""What a worker does with a scene. It opens the model when the first scene needs it, and keeps it open."""

import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from ..inference.model_files import ModelFiles
from ..inference.predictor import Predictor
from ..inference.providers import candidates
from ..inference.session import SessionConfig
from ..reconstruction.pipeline import reconstruct
from ..splats.filtering import FilterOptions
from ..system.files import atomic_write, make_folder
from .records import SPLATS, TRACEBACK, Status, file_sha256, fingerprint, is_done, read_record, write_record
from .scenes import FILTERS, Scene


@dataclass(frozen=True)
class Settings:
    """What all scenes of a run have in common. model_sha256: of `records.model_sha256`."""

    model: ModelFiles
    model_sha256: str
    provider: str
    session: SessionConfig
    options: Mapping[str, Any]
    retry_failed: bool = False


class Outcome(NamedTuple):
    """The record of a scene, and whether it was tried in this run."""

    record: dict[str, Any]
    tried: bool


@dataclass
class Worker:
    """Reconstructs scenes one after the other with one opened model."""

    settings: Settings
    _predictor: Predictor | None = field(default=None, init=False)

    def run(self, scene: Scene, folder: Path) -> Outcome:
        """Reconstruct a scene into its folder, unless the record there says that it is done or has failed.

        A failure is returned as a record, and is written down where the disk takes it.
        Raises InputError if the model cannot be opened.
        """
        started = time.perf_counter()
        made_from: str | None = None
        before = read_record(folder) or {}
        try:
            made_from = self._fingerprint(scene)
            if is_done(folder, before, made_from) or self._stays_failed(before, made_from):
                return Outcome(before, False)
        except Exception as error:
            if self._stays_failed(before, made_from):
                return Outcome(before, False)
            return Outcome(self._fail(scene, folder, made_from, error, started), True)
        predictor = self._open()
        try:
            make_folder(folder)
            # No record of other splats may stand beside new ones, and a killed worker leaves what it worked on.
            write_record(folder, {"id": scene.id, "hash": made_from, "status": Status.STARTED})
            (folder / SPLATS).unlink(missing_ok=True)
            record = self._reconstruct(scene, folder, predictor)
            record |= {"hash": made_from, "seconds": time.perf_counter() - started}
            (folder / TRACEBACK).unlink(missing_ok=True)
            write_record(folder, record)
        except Exception as error:  # one scene's failure must not end the others
            record = self._fail(scene, folder, made_from, error, started)
        return Outcome(record, True)

    def _fingerprint(self, scene: Scene) -> str:
        options = {**self.settings.options, **scene.options}
        providers = ",".join(provider.name for provider in candidates(self.settings.provider))
        return fingerprint(scene, options, self.settings.model_sha256, providers)

    def _stays_failed(self, before: Mapping[str, Any], made_from: str | None) -> bool:
        failed = before.get("status") == Status.FAILED and before.get("hash") == made_from
        return failed and not self.settings.retry_failed

    def _open(self) -> Predictor:
        if self._predictor is None:
            self._predictor = Predictor(self.settings.model, self.settings.provider, self.settings.session)
        return self._predictor

    def _reconstruct(self, scene: Scene, folder: Path, predictor: Predictor) -> dict[str, Any]:
        """Write the splats; the record of them."""
        options = {**self.settings.options, **scene.options}
        filters = FilterOptions(**{name: options.pop(name) for name in FILTERS if name in options})
        result = reconstruct(scene.images, scene.cameras, model=predictor, filters=filters, **options)
        lost = result.save(folder / SPLATS)
        return {
            "id": scene.id,
            "status": Status.DONE,
            "version": version("idesplat"),
            "sha256": file_sha256(folder / SPLATS),
            "gaussians": 0 if result.gaussians is None else len(result.gaussians),
            "views": result.views.names,
            "notes": [*result.notes, *lost],
            "timings": result.timings,
        }

    def _fail(
        self, scene: Scene, folder: Path, made_from: str | None, error: Exception, started: float
    ) -> dict[str, Any]:
        """The record of a failure; written, but for a disk that is full or the like, and then the scene is not done."""
        line = " ".join(str(error).split()) or type(error).__name__
        line = line if isinstance(error, InputError) else f"{type(error).__name__}: {line}"
        seconds = time.perf_counter() - started
        record = {"id": scene.id, "status": Status.FAILED, "error": line, "hash": made_from, "seconds": seconds}
        with suppress(InputError, OSError):
            make_folder(folder)
            with atomic_write(folder / TRACEBACK) as temporary:
                text = "".join(traceback.format_exception(error))
                temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
            write_record(folder, record)
        return record
