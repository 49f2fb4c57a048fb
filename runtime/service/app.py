"""The HTTP interface of a service."""

from collections.abc import AsyncIterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp

from ..errors import InputError, one_line
from ..system.output_names import CAMERAS_FILE, SUMMARY
from ..web.site import PAGE as WEB_PAGE
from .jobs import Job, State
from .limits import Refused
from .protection import Protection
from .schema import Problem, Scene, request_body
from .service import Service
from .worker import DEPTH, RENDERS

PAGE = Path(__file__).with_name("page")
BASE_STYLE = WEB_PAGE / "base.css"  # which the page shares with that of `idesplat web`
HEARTBEAT_S = 15.0  # between events of a job that does not change, so that proxies keep the connection
BAD_INPUT = 422
PROBLEMS: dict[int | str, dict[str, Any]] = {
    401: {"model": Problem, "description": "The token is missing or wrong"},
    404: {"model": Problem, "description": "No such scene, or no such file of it"},
}
UPLOAD_PROBLEMS = PROBLEMS | {
    408: {"model": Problem, "description": "The upload comes too slowly"},
    413: {"model": Problem, "description": "Too large: the upload, an image, or the number of images or views"},
    415: {"model": Problem, "description": "No multipart form, or a file of another type"},
    422: {"model": Problem, "description": "An image, a zip, cameras or an option is invalid"},
    429: {"model": Problem, "description": "The queue is full; Retry-After says when to try again"},
    503: {"model": Problem, "description": "The service stops"},
    507: {"model": Problem, "description": "There is no room on the service's disk"},
}


def make_app(service: Service) -> ASGIApp:
    """The application of a service, with its protection."""
    app = FastAPI(
        title="idesplat",
        version=version("idesplat"),
        description="Images to 3D Gaussian splats.",
        docs_url=None,  # it loads scripts of another host
        redoc_url=None,
        telemetry={"tracing": False, "metrics": False, "logs": False, "auto_configure": False},
    )
    app.add_exception_handler(Refused, _answer_refused)
    app.add_exception_handler(InputError, _answer_input_error)
    app.add_exception_handler(ClientDisconnect, _answer_nobody)
    _add_scenes(app, service)
    _add_probes(app, service)
    app.mount("/page", StaticFiles(directory=PAGE))
    settings = service.settings
    return Protection(app, settings.host, settings.token, service.metrics.count_answer)


def _answer_refused(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, Refused)
    headers = {} if error.retry_after is None else {"Retry-After": str(error.retry_after)}
    return JSONResponse({"detail": error.message}, error.status, headers)


def _answer_input_error(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": one_line(error)}, BAD_INPUT)


def _answer_nobody(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": "the connection was lost before the request had ended"}, 400)


def _add_scenes(app: FastAPI, service: Service) -> None:
    jobs = service.jobs

    @app.post(
        "/v1/scenes",
        status_code=202,
        response_model=Scene,
        responses=UPLOAD_PROBLEMS,
        openapi_extra={"requestBody": request_body()},
        summary="Send images, and start a reconstruction",
    )
    async def post_scene(request: Request) -> JSONResponse:
        scene = Scene.of(await service.submit(request), jobs)
        return JSONResponse(scene.model_dump(mode="json"), 202, {"Location": scene.url})

    @app.get("/v1/scenes/{scene_id}", response_model=Scene, responses=PROBLEMS, summary="The state of a scene")
    async def get_scene(scene_id: str) -> Scene:
        return Scene.of(jobs.get(scene_id), jobs)

    @app.get(
        "/v1/scenes/{scene_id}/events",
        response_class=StreamingResponse,
        responses=PROBLEMS | {200: {"content": {"text/event-stream": {}}, "description": "The state at every change"}},
        summary="Follow a scene by server-sent events",
    )
    async def get_events(scene_id: str) -> StreamingResponse:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(_events(service, jobs.get(scene_id)), headers=headers, media_type="text/event-stream")

    @app.delete("/v1/scenes/{scene_id}", status_code=204, responses=PROBLEMS, summary="Cancel or remove a scene")
    async def delete_scene(scene_id: str) -> Response:
        jobs.cancel(jobs.get(scene_id))
        return Response(status_code=204)

    @app.get("/v1/scenes/{scene_id}/{name}", response_class=FileResponse, responses=PROBLEMS, summary="A result")
    async def get_file(scene_id: str, name: str) -> FileResponse:
        job = _done(service, scene_id)
        if name in (SUMMARY, CAMERAS_FILE):
            return _file(job.out / name)
        if not name.startswith("scene."):
            raise Refused(404, "no such file; `files` of the scene lists what there is")
        return _file(await service.scene_file(job, name.removeprefix("scene")))

    @app.get(
        "/v1/scenes/{scene_id}/{kind}/{name}",
        response_class=FileResponse,
        responses=PROBLEMS,
        summary="A depth map or rendered view",
    )
    async def get_view(scene_id: str, kind: str, name: str) -> FileResponse:
        job = _done(service, scene_id)
        if kind not in (DEPTH, RENDERS) or f"{kind}/{name}" not in job.files():
            raise Refused(404, "no such file; `files` of the scene lists what there is")
        return _file(job.out / kind / name)


def _add_probes(app: FastAPI, service: Service) -> None:
    @app.get("/health", summary="Whether the service runs")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/ready", summary="Whether the service takes scenes")
    async def ready() -> JSONResponse:
        return JSONResponse({"ready": service.is_ready}, 200 if service.is_ready else 503)

    @app.get("/metrics", response_class=Response, summary="Metrics for Prometheus")
    async def metrics() -> Response:
        return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    @app.get("/page/base.css", include_in_schema=False)
    async def base_style() -> FileResponse:
        return FileResponse(BASE_STYLE)


async def _events(service: Service, job: Job) -> AsyncIterator[str]:
    """The state of a job now, at every change, and at its end, as server-sent events."""
    async for _ in job.changes(HEARTBEAT_S):
        yield f"event: {job.state}\ndata: {Scene.of(job, service.jobs).model_dump_json()}\n\n"


def _done(service: Service, scene_id: str) -> Job:
    """The job with an id, if it has results. Raises Refused."""
    job = service.jobs.get(scene_id)
    if job.state is not State.DONE:
        raise Refused(409, f"the scene is {job.state}" + (f": {job.error}" if job.error else "; it has no results yet"))
    return job


def _file(path: Path) -> FileResponse:
    if not path.is_file():
        raise Refused(404, "no such file; `files` of the scene lists what there is")
    return FileResponse(path, filename=path.name)
