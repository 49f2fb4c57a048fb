"""Reconstruct a scene from images, save it and render a view of it.

python library.py PHOTOS OUT
"""

import sys
from pathlib import Path

import idesplat
import numpy as np
from PIL import Image


def main() -> None:
    """Read the arguments, reconstruct, and write the results."""
    photos, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)

    reconstruction = idesplat.reconstruct(photos, views=2, quality="fast")  # the default quality takes longer
    gaussians = reconstruction.gaussians  # means, quats, scales, opacities, sh
    print(f"{len(gaussians.means)} Gaussians, depth maps {reconstruction.depth.shape}")
    idesplat.write_splats(out / "scene.ply", gaussians)

    rendering = next(idesplat.render(gaussians, reconstruction.cameras))  # one view at a time
    Image.fromarray((rendering.rgb.clip(0, 1) * 255).round().astype(np.uint8)).save(out / "view.png")


if __name__ == "__main__":
    main()
