"""A class that Ray Data, Dask, Spark and the like map over their own data."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..inference.named_models import find_model
from ..inference.providers import CPU
from ..inference.session import DEFAULT, SessionConfig, usable_cores
from .cache import DEFAULT_GB
from .places import join, parse_place
from .records import PLY, splats_name
from .scenes import make_scene
from .worker import Worker, check_settings, make_settings, start_worker


class SceneReconstructor:
    """Reconstructs one scene after the other with one opened model: rows to rows.

        ray.data.from_items(rows).map(SceneReconstructor, fn_constructor_args=["s3://bucket/results"], concurrency=8)

    out: folder or URL for `<id>/scene.ply` and `<id>/record.json`, as `batch` writes them; what is done is not done
    again. model, options, splat_format, provider, retry_failed, cache_gb, overwrite: as in `batch`.
    session: its `threads` are those that the process takes, all cores by default; schedulers that run several workers
    on a machine want fewer.
    An instance can be pickled before its first scene. Raises InputError for invalid arguments.
    """

    def __init__(
        self,
        out: Path | str,
        *,
        model: Path | str | None = None,
        options: Mapping[str, Any] | None = None,
        splat_format: str = PLY,
        provider: str = CPU,
        session: SessionConfig = DEFAULT,
        retry_failed: bool = False,
        cache_gb: float = DEFAULT_GB,
        overwrite: bool = False,
    ) -> None:
        check_settings(options, provider, splat_format, cache_gb)
        self._threads = session.threads or usable_cores()
        self._settings = make_settings(
            find_model(model),
            parse_place(out),
            options=options,
            splat_format=splat_format,
            provider=provider,
            session=replace(session, threads=self._threads),
            retry_failed=retry_failed,
            cache_gb=cache_gb,
            overwrite=overwrite,
        )
        self._worker: Worker | None = None

    def __call__(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Reconstruct the scene of a row with id, images, cameras and options, as in a table of `batch`.

        Relative paths are relative to the current folder. The result has columns that are the same for each scene: id,
        status ("done" or "failed"), splats (their path or URL), error, gaussians, psnr (dB), seconds and peak_memory
        (bytes), None where there is none. A scene that fails is such a row. InputError is raised for an invalid row,
        and for a model that cannot be opened.
        """
        if self._worker is None:
            self._worker = start_worker(self._settings, self._threads)
        scene = make_scene(row, Path("rows"))
        record = self._worker.run(scene).record
        splats = join(join(self._settings.out, scene.id), splats_name(self._settings.splat_format))
        return {
            "id": scene.id,
            "status": str(record["status"]),
            "splats": str(splats) if "error" not in record else None,
            **{name: record.get(name) for name in ("error", "gaussians", "psnr", "seconds", "peak_memory")},
        }
