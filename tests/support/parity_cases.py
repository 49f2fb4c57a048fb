"""The reference cases' arrays beside the networks' tensors."""

import torch

CASES = {"idesplat-re10k-2v-256x256": "idesplat-re10k", "idesplat-dl3dv-2v-256x448": "idesplat-dl3dv"}
DEPTHSPLAT_CASES = {
    "depthsplat-small-2v-256x256": "depthsplat-small-re10k",
    "depthsplat-base-2v-256x256": "depthsplat-base-re10k",
}


def share_within(found, expected, tolerance):
    """The share of elements that are off by no more than the tolerance."""
    return ((found - expected).abs() <= tolerance).float().mean().item()


def as_reference(gaussians, expected):
    """Pairs of our Gaussians and the reference's by name, both in the usual 3DGS conventions."""
    s = expected["harmonics"].unbind(-1)
    root = 3**0.5 / 2
    bands = [s[0], -s[2], -s[3], s[1], -s[5], s[7], -s[6] / 2 + root * s[8], -s[4], -root * s[6] - s[8] / 2]
    w, x, y, z = gaussians.quats.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    axes = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2) * gaussians.scales[:, None]
    return {
        "means": (gaussians.means, expected["means"]),
        "covariances": (axes @ axes.transpose(1, 2), expected["covariances"]),
        "opacities": (gaussians.opacities, expected["opacities"]),
        "scales": (gaussians.scales, expected["scales"]),
        "sh": (gaussians.sh, torch.stack(bands, dim=1)),
    }
