"""The API's data for its description in OpenAPI, with examples."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from .fields import FIELDS
from .jobs import Job, Jobs, State
from .service import ENDINGS, RENDER, SAVE_DEPTH

EXAMPLE_ID = "5f0c1f1d9a4b4f0e8a3c2b1d0e9f8a7b"
EXAMPLE: dict[str, Any] = {
    "id": EXAMPLE_ID,
    "state": "done",
    "created": 1767225600.0,
    "started": 1767225600.2,
    "finished": 1767225603.9,
    "position": None,
    "progress": None,
    "error": None,
    "gaussians": 131072,
    "views": ["0001.jpg", "0002.jpg"],
    "notes": ["cameras estimated from 2 images"],
    "files": ["cameras.json", "depth/0001.npz", "depth/0001.png", "scene.ply", "summary.json"],
    "url": f"/v1/scenes/{EXAMPLE_ID}",
}


class Progress(BaseModel):
    """What is being done, and how far it is; total is null where it is not known."""

    description: str
    done: int
    total: int | None


class Scene(BaseModel):
    """One scene. Times are seconds since 1970. position: scenes before it in the queue."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE]})

    id: str
    state: State
    created: float
    started: float | None
    finished: float | None
    position: int | None
    progress: Progress | None
    error: str | None
    gaussians: int | None
    views: list[str]
    notes: list[str]
    files: list[str] = Field(description=f"Results, relative to `url`. scene.ply is also there as {', '.join(ENDINGS)}")
    url: str

    @classmethod
    def of(cls, job: Job, jobs: Jobs) -> "Scene":
        """The present state of a job."""
        return cls(
            id=job.id,
            state=job.state,
            created=job.created,
            started=job.started,
            finished=job.finished,
            position=jobs.position(job),
            progress=Progress(**job.progress) if job.progress else None,
            error=job.error,
            gaussians=job.result.get("gaussians"),
            views=job.result.get("views", []),
            notes=job.result.get("notes", []),
            files=job.files(),
            url=f"/v1/scenes/{job.id}",
        )


class Problem(BaseModel):
    """Why a request was not served, in one line."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"detail": "1 images, expected 2 or more"}]})

    detail: str


def request_body() -> dict[str, Any]:
    """The multipart form of a scene, as OpenAPI has it."""
    files = {"type": "array", "items": {"type": "string", "format": "binary"}}
    properties: dict[str, Any] = {
        "images": files | {"description": "Two or more images, or one zip of images, with their cameras if there are."},
        "cameras": files
        | {"description": "transforms.json, the files of a COLMAP model and others; estimated where there are none."},
    }
    for name, field in FIELDS.items():
        properties[name] = {"type": field.kind, "description": field.description, "example": field.example}
        if field.choices:
            properties[name]["enum"] = list(field.choices)
    properties[SAVE_DEPTH] = {"type": "boolean", "default": True, "description": "Make depth maps: depth/*.png, *.npz."}
    properties[RENDER] = {"type": "boolean", "default": False, "description": "Render views: renders/*.png."}
    schema = {"type": "object", "required": ["images"], "properties": properties}
    examples = {
        "fast": {"summary": "Two images, the prediction alone", "value": {"quality": "fast"}},
        "refined": {"summary": "Six of the images, refined", "value": {"views": "6", "refine": "20s", "render": True}},
    }
    return {"required": True, "content": {"multipart/form-data": {"schema": schema, "examples": examples}}}
