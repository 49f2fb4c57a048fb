"""A list of captures with a single one, which is made from a scene's images."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.tools.evaluation.captures import capture as captures
from idesplat.tools.evaluation.captures.choose import as_json, camera_entries


def git(folder: Path, *arguments: str) -> str:
    """What git prints in a folder."""
    author = ("-c", "user.name=a", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", "-C", folder, *author, *arguments], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def commit_all(root: Path) -> str:
    """Make a folder a work tree with all its files in one commit, whose hash is returned."""
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "commit", "--quiet", "--message", "images")
    return git(root, "rev-parse", "HEAD")


def list_one_capture(
    path: Path,
    scene: Path,
    fields: Mapping[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    depth_range: tuple[float, float] | None = None,
) -> None:
    """Write the list of captures to a file, and use it: the capture `room` with a scene's cameras.

    fields: those of the list that are not about cameras. depth_range: near and far of all cameras.
    """
    cameras = [
        Camera(
            Path(camera.name).name, camera.width, camera.height, camera.K, camera.extrinsics, depth_range=depth_range
        )
        for camera in read_cameras(scene / "transforms.json")
    ]
    described = {"name": "room", "kind": "room", "content": "a room", "licence": "CC0", "cameras": "transforms.json"}
    path.write_text(as_json([{**described, **camera_entries(cameras), **fields}]))
    monkeypatch.setattr(captures, "CAPTURES_FILE", path)
