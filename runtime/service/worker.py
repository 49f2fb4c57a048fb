"""A worker process of the service: opens the model, and reconstructs one scene after the other.

It reads one JSON object a line from standard input, first the `Setup`, then an `Order` for each scene, and answers
likewise on standard output: `ready`, then `progress` and finally `done` or `failed` for each order.
"""

import json
import os
import queue
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import cv2

from ..batch.scenes import parse_option, split_filters
from ..cameras.image_files import confine_to
from ..cameras.io import write_cameras
from ..errors import InputError
from ..inference.predictor import Predictor
from ..inference.session import SessionConfig
from ..reconstruction.pipeline import reconstruct
from ..reconstruction.result import Reconstruction
from ..system.files import make_folder
from ..system.output_names import CAMERAS_FILE, SPLATS, SUMMARY
from ..system.progress import Progress, reporting_to
from ..system.threads import limit_threads

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

SCENE, DEPTH, RENDERS = f"scene{SPLATS}", "depth", "renders"
STDOUT = 1
REPORT_S = 0.2  # between reports of progress on one piece of work
OOM_SCORE = "800"  # of 1000: where memory runs out, the system ends a worker before the service


@dataclass(frozen=True)
class Setup:
    """What all scenes have in common: the model's path, provider, threads, device, and limits.

    megapixels: of an image. memory_bytes: of the process; None for no limit.
    """

    model: str
    provider: str
    threads: int
    device: str | None
    provider_options: Mapping[str, str]
    megapixels: int
    memory_bytes: int | None


@dataclass(frozen=True)
class Order:
    """One scene: paths of its images and cameras, the form fields, and the folder of the results, in its own folder."""

    images: str
    cameras: str | None
    options: Mapping[str, str]
    folder: str
    save_depth: bool
    render: bool


class _Reports:
    """Writes what is reported, and of progress that comes fast only some."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._last: tuple[str, float] = ("", 0.0)

    def send(self, **message: Any) -> None:
        print(json.dumps(message), file=self._stream, flush=True)

    def progress(self, progress: Progress) -> None:
        description, now = progress.description, time.monotonic()
        if progress.ended or (description == self._last[0] and now < self._last[1] + REPORT_S):
            return
        self._last = (description, now)
        self.send(progress={"description": description, "done": progress.done, "total": progress.total})


def main() -> None:
    """Serve until standard input ends, which it does with the service."""
    reports = _Reports(os.fdopen(os.dup(STDOUT), "w", encoding="utf-8"))
    os.dup2(os.open(os.devnull, os.O_WRONLY), STDOUT)  # what libraries print is none of our messages
    lines: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    setup = Setup(**json.loads(lines.get()))
    _limit(setup)
    try:
        session = SessionConfig(setup.threads, device=setup.device, provider_options=setup.provider_options)
        predictor = Predictor(Path(setup.model), setup.provider, session)
    except InputError as error:
        reports.send(failed=str(error))
        return
    reports.send(ready=True)
    while True:
        _serve(Order(**json.loads(lines.get())), predictor, reports)


def _read(lines: "queue.Queue[str]") -> None:
    """Pass on what comes, and end this process with the service, also in the middle of its work."""
    for line in sys.stdin:
        lines.put(line)
    os._exit(1)


def _limit(setup: Setup) -> None:
    limit_threads(setup.threads)
    cv2.setNumThreads(setup.threads)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE)
    if resource is not None and setup.memory_bytes is not None:
        resource.setrlimit(resource.RLIMIT_DATA, (setup.memory_bytes, setup.memory_bytes))


def _serve(order: Order, predictor: Predictor, reports: _Reports) -> None:
    root = Path(order.folder).parent
    try:
        with reporting_to(reports.progress), confine_to(root):
            reports.send(done=_reconstruct(order, predictor))
    except InputError as error:
        reports.send(failed=_without(root, str(error)).replace(str(predictor.model.path), "the model"))
    except MemoryError:
        reports.send(failed="memory ran out; send fewer or smaller images, or ask for fewer views or a smaller size")
    except Exception as error:  # one scene's failure must not end the others
        details = "".join(traceback.format_exception(error))
        reports.send(failed=f"internal error ({type(error).__name__}); the service's log has more", details=details)


def _reconstruct(order: Order, predictor: Predictor) -> dict[str, Any]:
    """Write the results; what is worth knowing of them at once."""
    filters, options = split_filters({name: parse_option(name, text) for name, text in order.options.items()})
    result = reconstruct(order.images, order.cameras, model=predictor, filters=filters, **options)
    folder = make_folder(Path(order.folder))
    notes = [*result.notes, *result.save(folder / SCENE)]
    files = [folder / SCENE]
    if order.save_depth:
        files += result.save_depth(folder / DEPTH)
    if order.render and result.gaussians is not None:
        files += result.save_renders(folder / RENDERS)
    _save_cameras(result, Path(order.images), folder / CAMERAS_FILE)
    summary = result.summary([*files, folder / CAMERAS_FILE])
    summary["model"]["path"] = Path(summary["model"]["path"]).name
    summary["notes"] = notes
    summary["files"] = [path.relative_to(folder).as_posix() for path in [*files, folder / CAMERAS_FILE]]
    text = _without(folder.parent, json.dumps(summary, indent=2))
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
    return {
        "gaussians": 0 if result.gaussians is None else len(result.gaussians),
        "views": result.views.names,
        "notes": [_without(folder.parent, line) for line in notes],
        "seconds": result.timings,
    }


def _save_cameras(result: Reconstruction, images: Path, path: Path) -> None:
    """Write the cameras of all images, estimated ones named as the images were sent."""
    cameras = [
        replace(camera, name=Path(camera.name).relative_to(images).as_posix())
        if result.inputs.estimated and Path(camera.name).is_relative_to(images)
        else camera
        for camera in result.inputs.cameras
    ]
    write_cameras(path, cameras)


def _without(root: Path, text: str) -> str:
    """The text without the path of the service's folder, as itself and as JSON has it."""
    for prefix in (f"{root}{os.sep}", json.dumps(f"{root}{os.sep}")[1:-1]):
        text = text.replace(prefix, "")
    return text


def as_line(message: Setup | Order) -> bytes:
    """A message to a worker."""
    return (json.dumps(asdict(message)) + "\n").encode()


if __name__ == "__main__":
    main()
