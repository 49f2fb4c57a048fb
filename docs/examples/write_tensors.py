"""Write the input tensors of an exported graph as raw float32 files, with NumPy and Pillow alone.

    python write_tensors.py SCENE OUT --near 1.0 --far 8.0 [--size 256x256] [--views 0,2] [--trained-near 1.0]

SCENE holds a transforms.json (OpenGL camera-to-world poses, no lens distortion) and its images. near and far are the
depth range of the scene in the unit of its poses. OUT receives images.f32, extrinsics.f32, intrinsics.f32, near.f32
and far.f32 (little endian, row-major), and frame.json and frame.f32 (scale, origin), which lead the results back into
the scene's frame and unit.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def load_view(path: Path, camera: dict, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """One image, centre-cropped and resized, [3, height, width] in [0, 1], and its normalized intrinsics [3, 3]."""
    image = Image.open(path).convert("RGB")
    crop_width = min(image.width, round(image.height * width / height))
    crop_height = min(image.height, round(image.width * height / width))
    left, top = (image.width - crop_width) // 2, (image.height - crop_height) // 2
    image = image.crop((left, top, left + crop_width, top + crop_height)).resize((width, height), Image.Resampling.BOX)
    intrinsics = np.array(
        [
            [camera["fl_x"] / crop_width, 0, (camera["cx"] - left) / crop_width],
            [0, camera["fl_y"] / crop_height, (camera["cy"] - top) / crop_height],
            [0, 0, 1],
        ]
    )
    return np.asarray(image, np.float32).transpose(2, 0, 1) / 255, intrinsics


def main() -> None:
    """Read the arguments, and write the tensors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--near", type=float, required=True)
    parser.add_argument("--far", type=float, required=True)
    parser.add_argument("--size", default="256x256")
    parser.add_argument("--views", default="0,1")
    parser.add_argument("--trained-near", type=float, default=1.0, help="`near` in the model's metadata")
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))

    transforms = json.loads((arguments.scene / "transforms.json").read_text())
    frames = [transforms["frames"][int(index)] for index in arguments.views.split(",")]
    loaded = [
        load_view(arguments.scene / frame["file_path"], {**transforms, **frame}, height, width) for frame in frames
    ]
    extrinsics = np.array([frame["transform_matrix"] for frame in frames]) @ OPENGL_TO_OPENCV

    # The network works in the unit in which `near` is what it was in training, with the cameras around the origin.
    origin = extrinsics[:, :3, 3].mean(axis=0)
    scale = arguments.trained_near / arguments.near
    extrinsics[:, :3, 3] = (extrinsics[:, :3, 3] - origin) * scale
    tensors = {
        "images": np.stack([image for image, _ in loaded]),
        "extrinsics": extrinsics,
        "intrinsics": np.stack([intrinsics for _, intrinsics in loaded]),
        "near": np.full(len(frames), arguments.near * scale),
        "far": np.full(len(frames), arguments.far * scale),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, values in tensors.items():
        values.astype("<f4").tofile(arguments.out / f"{name}.f32")
    np.array([scale, *origin], "<f4").tofile(arguments.out / "frame.f32")
    frame = {"views": len(frames), "height": height, "width": width, "origin": origin.tolist(), "scale": scale}
    (arguments.out / "frame.json").write_text(json.dumps(frame, indent=1) + "\n")


if __name__ == "__main__":
    main()
