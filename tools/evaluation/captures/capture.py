"""The validation captures: frames of public repositories, with their cameras.

`captures.json` holds one object for each capture:

{"format": "idesplat-captures", "version": 1, "captures": [
  {"name": "fountain", "kind": "facade", "content": "...", "licence": "...",
   "repository": "OWNER/NAME", "commit": "<40 hex digits>", "folder": "path/of/its/images",
   "cameras": "estimated",                 or the path of the camera file in the repository
   "crop": [left, top, right, bottom],     of each image, in pixels, or null; the lenses are those of the crop
   "epipolar_px": 0.11,                    median distance of SIFT matches from their epipolar lines, at 640 pixels
   "lenses": [{"width": 768, "height": 512, "K": [fx, fy, cx, cy], "distortion": null}],
   "frames": [["0000.png", 0, [qw, qx, qy, qz], [x, y, z], [near, far]]],
   "triples": [["0000.png", "0002.png", "0001.png"]],
   "views": ["0000.png", ...], "between": ["0001.png", ...]}]}

A frame is its file name, the index of its lens, the camera-to-world rotation and position (OpenCV axes), and the depth
range that the camera is known to see, or null. Pixel centres are at .5. Of a triple, the last frame is held out.
`between[i]` is held out between `views[i]` and `views[i + 1]`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ....runtime.cameras.camera import Camera, resize_camera
from ....runtime.cameras.parsing import entries, read_json
from ....runtime.cameras.undistortion import shrink
from ....runtime.errors import InputError, error_context
from ....runtime.geometry.intrinsics import intrinsic_matrix
from ....runtime.geometry.quaternions import quaternions_to_matrices
from ....runtime.images.io import load_image
from ....runtime.system.limits import parse_whole_number
from ....runtime.views.batch import ViewBatch, build_view_batch
from ....runtime.views.depth_range import DepthRange
from ....runtime.views.loader import ImageCameraPair, load_view
from ..cases import EvalCase, PosedImages
from ..image_folders import valid_pixels

CAPTURES_FILE = Path(__file__).with_name("captures.json")
FORMAT, VERSION = "idesplat-captures", 1
PAIR = 2  # context views of a triple
MAX_VIEWS = 24  # of a path

FindRange = Callable[[ViewBatch], DepthRange]
Crop = tuple[int, int, int, int]  # left, top, right, bottom in pixels


@dataclass(frozen=True)
class Triple:
    """Two context frames and the held-out one between them, as names of frames."""

    context: tuple[str, str]
    target: str


@dataclass(frozen=True)
class CaptureSource:
    """Where a capture comes from: the images in a folder of a public repository at a pinned commit."""

    name: str
    kind: str
    content: str
    licence: str
    repository: str
    commit: str
    folder: str


@dataclass(frozen=True, eq=False)
class Capture(CaptureSource):
    """One capture of the file, as the module describes it; cameras by frame name."""

    cameras: dict[str, Camera]
    triples: list[Triple]
    views: list[str]
    between: list[str]
    crop: Crop | None = None

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        return list(self.cameras)

    def window(self, count: int) -> tuple[list[str], list[str]]:
        """The `count` views in the middle of the path, and the held-out frames between them; empty if too few.

        A window of more views contains every smaller one.
        """
        if count > len(self.views):
            return [], []
        first = window_start(len(self.views), count)
        return self.views[first : first + count], self.between[first : first + count - 1]

    def neighbours(self, target: str) -> Triple:
        """A frame of `between` with the two views on either side of it."""
        index = self.between.index(target)
        return Triple((self.views[index], self.views[index + 1]), target)


@dataclass(frozen=True, eq=False)
class LoadedFrame:
    """A frame at the network's size: image [3, height, width], intrinsics [3, 3], valid [height, width]."""

    image: np.ndarray
    intrinsics: np.ndarray
    camera: Camera
    valid: np.ndarray


class CaptureImages:
    """A capture's images in a folder, each loaded once at the network's size.

    folder: contains the capture's frames under their names. size: height and width.
    """

    def __init__(self, capture: Capture, folder: Path, size: tuple[int, int]) -> None:
        self.capture, self.folder, self.size = capture, folder, size
        self._loaded: dict[str, LoadedFrame] = {}

    def pairs(self, names: Sequence[str]) -> list[ImageCameraPair]:
        """Images with their cameras, at the images' own size; files, or arrays where the capture is cropped."""
        crop, cameras = self.capture.crop, self.capture.cameras
        paths = {name: self.folder / name for name in names}
        return [(path if crop is None else load_cropped(path, crop), cameras[name]) for name, path in paths.items()]

    def case(self, context: Sequence[str], targets: Sequence[str], find_range: FindRange) -> EvalCase:
        """Context and held-out frames as arrays, with near and far from the context views.

        Raises InputError for images that cannot be read or have another size than their cameras.
        """
        views = self._views(context)
        found = find_range(views)
        name = f"{self.capture.name}-{len(context)}-{Path(context[0]).stem}"
        return EvalCase(name, self._posed(context), self._posed(targets), found.near, found.far)

    def without_defects(self, names: Sequence[str]) -> list[str]:
        """These frames without those that `idesplat infer` would leave out, for what they show or their cameras."""
        pairs = self.pairs(names)
        return build_view_batch(pairs, None, *self.size, skip_damaged=True, check_images=True, check_cameras=True).names

    def _views(self, names: Sequence[str]) -> ViewBatch:
        frames = [self._load(name) for name in names]
        return ViewBatch(
            list(names),
            np.stack([frame.image for frame in frames]),
            np.stack([frame.camera.extrinsics for frame in frames]),
            np.stack([frame.intrinsics for frame in frames]),
            [frame.camera for frame in frames],
        )

    def _posed(self, names: Sequence[str]) -> PosedImages:
        views = self._views(names)
        valid = np.stack([self._load(name).valid for name in names])
        return PosedImages(views.names, views.images, views.extrinsics, views.intrinsics, valid)

    def _load(self, name: str) -> LoadedFrame:
        if name not in self._loaded:
            image, camera = load_cropped(self.folder / name, self.capture.crop), self.capture.cameras[name]
            view = load_view((image, camera), *self.size)
            valid = valid_pixels(image, camera, *self.size)
            self._loaded[name] = LoadedFrame(view.image, view.intrinsics, view.camera, valid)
        return self._loaded[name]


def load_cropped(path: Path, crop: Crop | None) -> np.ndarray:
    """The image in a file, or a crop of it, uint8 RGB [height, width, 3]; raises InputError as `load_image`."""
    image = load_image(path)
    if crop is None:
        return image
    left, top, right, bottom = crop
    return image[top:bottom, left:right]


def load_shrunk(capture: Capture, folder: Path, name: str, max_side: int) -> tuple[np.ndarray, Camera]:
    """A frame in a folder, its longer side at most `max_side` pixels, and its camera; raises InputError."""
    image = load_cropped(folder / name, capture.crop)
    return shrink(image, resize_camera(capture.cameras[name], image.shape[1], image.shape[0]), max_side)


def window_start(views: int, count: int) -> int:
    """The index of the first of the `count` views in the middle of a path of so many views."""
    return (views - count) // 2


def read_captures(names: Sequence[str] = (), path: Path | None = None) -> list[Capture]:
    """The captures of the package's file, or of another one, or those named of them, in order; raises InputError."""
    path = path or CAPTURES_FILE
    with error_context(str(path)):
        document = read_json(path)
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            raise InputError(f'expected "format": "{FORMAT}" and "version": {VERSION}; update idesplat')
        captures = [_capture(entry) for entry in entries(document, "captures")]
    known = [capture.name for capture in captures]
    for name in names:
        if name not in known:
            raise InputError(f"--capture {name}: no such capture; expected one of {', '.join(known)}")
    return [capture for capture in captures if not names or capture.name in names]


def parse_view_counts(text: str) -> list[int]:
    """The option --views, such as `2,6`: numbers of context views, in rising order; raises InputError."""
    counts = [parse_whole_number(word.strip()) or 0 for word in text.split(",")]
    if not all(PAIR <= count <= MAX_VIEWS for count in counts):
        raise InputError(f"--views {text}: expected numbers from {PAIR} to {MAX_VIEWS} with commas, such as 2,6")
    return sorted(set(counts))


def _capture(entry: dict[str, Any]) -> Capture:
    texts = [field.name for field in fields(CaptureSource)]
    with error_context(str(entry.get("name"))):
        try:
            cameras = {frame[0]: _camera(entry["lenses"], frame) for frame in entry["frames"]}
            triples = [Triple((first, second), target) for first, second, target in entry["triples"]]
            described = {text: entry[text] for text in texts}
            if not all(isinstance(text, str) for text in described.values()):
                raise TypeError(f"{', '.join(texts)} are not all strings")
            parts = {"views": entry["views"], "between": entry["between"], "crop": _crop(entry.get("crop"))}
            capture = Capture(**described, cameras=cameras, triples=triples, **parts)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"is not as this version writes it ({error}); restore the file") from None
        try:
            _check_frames(capture)
        except TypeError as error:
            raise InputError(f"is not as this version writes it ({error}); restore the file") from None
    return capture


def _crop(value: Any) -> Crop | None:
    if value is None:
        return None
    left, top, right, bottom = value
    if not all(isinstance(side, int) for side in value) or not (0 <= left < right and 0 <= top < bottom):
        raise ValueError(f"crop is {value}")
    return left, top, right, bottom


def _camera(lenses: list[dict[str, Any]], frame: list[Any]) -> Camera:
    name, lens, quaternion, position, depth_range = frame
    fields = lenses[lens]
    extrinsics = np.eye(4)
    extrinsics[:3, :3] = quaternions_to_matrices(np.array([quaternion]))[0]
    extrinsics[:3, 3] = position
    distortion = fields["distortion"] and tuple(fields["distortion"])
    near_far = depth_range and tuple(depth_range)
    K = intrinsic_matrix(*fields["K"])
    return Camera(name, fields["width"], fields["height"], K, extrinsics, distortion, depth_range=near_far)


def _check_frames(capture: Capture) -> None:
    used = [*capture.views, *capture.between]
    for triple in capture.triples:
        if triple.target in triple.context:
            raise InputError(f"{triple.target} is context and target of one triple, expected different frames")
        used += [*triple.context, triple.target]
    missing = set(used) - set(capture.cameras)
    if missing:
        raise InputError(f"{', '.join(sorted(missing))}: no camera, expected one for each frame that is used")
    if len(capture.between) != len(capture.views) - 1 or set(capture.between) & set(capture.views):
        raise InputError("expected one held-out frame between each two neighbouring views, none of them a view")
