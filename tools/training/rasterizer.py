"""A differentiable rasteriser of Gaussians for training, with gsplat's semantics and gradients for all inputs.

Projection (`geometry.projection`) and spherical harmonics (`geometry.sh`) are in PyTorch, compositing
(`rendering.types`) is compiled with numba for the CPU, also where the tensors are on a GPU: splats are visited front to
back, and each is composited over the pixels of its bounding box. The backward pass visits them back to front. Nothing
is stored per fragment: with T the transmittance behind a splat, that before it is T / (1 - alpha).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...model.common.quaternions import quaternions_to_matrices
from ...model.common.sh import SH_0, sh_basis
from ...runtime.geometry.projection import DISC_STD, EPS2D, FOV_MARGIN
from ...runtime.rendering.types import MAX_ALPHA, MIN_ALPHA
from ...runtime.system.compilation import compiled
from ...runtime.system.threads import map_in_threads

NEAR = 0.01  # scene units
MIN_TRANSMITTANCE = 1e-4

_compiled = compiled(fastmath={"contract", "arcp", "nsz"})


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
    aperture: float = 0.0,
    focus: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render Gaussians; returns rgb [height, width, 3], alpha and depth [height, width].

    means: world units, [gaussians, 3]. quats: wxyz, of any length but zero, [gaussians, 4]. scales: world units,
    [gaussians, 3]. opacities: in [0, 1], [gaussians]. sh: degree 0 to 3, [gaussians, (degree + 1)^2, 3].
    viewmat: world-to-camera, OpenCV axes, [4, 4]. K: pixels, pixel centres at .5, [3, 3]. background: [3].
    depth: sum of z-depth with the weights of colour, not divided by alpha. All tensors have one float type and device.
    aperture: diameter of a thin lens in world units, 0 for a pinhole. focus: z-depth of its plane in focus.
    """
    gaussians = (means, quats, scales, opacities, sh)
    splats = _splats(gaussians, viewmat, K, width, height, aperture, focus)
    image, transmittance = (part[0] for part in _Composite.apply(width, height, *splats))
    return image[..., :3] + transmittance[..., None] * background, 1 - transmittance, image[..., 3]


def render_images(scenes: Sequence[Sequence[Tensor]], viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Tensor:
    """Images on black, [images, height, width, 3], composited side by side in PyTorch's number of threads.

    scenes: for each image its Gaussians (means, scales, quats, opacities, sh). viewmats: [images, 4, 4].
    Ks: [images, 3, 3]. Units and frames as of `rasterize`.
    """
    splats: list[Tensor] = []
    for (means, scales, quats, opacities, sh), viewmat, K in zip(scenes, viewmats, Ks, strict=True):
        splats += _splats((means, quats, scales, opacities, sh), viewmat, K, width, height)
    images: Tensor = _Composite.apply(width, height, *splats)[0]
    return images[..., :3]


def _splats(
    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    aperture: float = 0.0,
    focus: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What is composited: centres and conics in pixels, opacities, and colours with z-depth, as of `_Composite`.

    gaussians: means, quats, scales, opacities, sh; all arguments as of `rasterize`.
    """
    means, quats, scales, opacities, sh = gaussians
    camera_means = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    seen = torch.nonzero(camera_means.detach()[:, 2] > NEAR)[:, 0]
    if len(seen) < len(means):
        camera_means, means, quats = camera_means[seen], means[seen], quats[seen]
        scales, opacities, sh = scales[seen], opacities[seen], sh[seen]
    centres, covariances = _project(camera_means, quats, scales, viewmat, K, width, height)
    if aperture:
        covariances, dimming = _defocus(covariances, camera_means[:, 2], K, aperture, focus)
        opacities = opacities * dimming
    conics = _conics(covariances)
    colours = _colours(sh, means, -viewmat[:3, :3].T @ viewmat[:3, 3])
    values = torch.cat([colours, camera_means[:, 2:]], dim=-1)  # [gaussians, 4]
    return centres, conics, opacities, values


def render_on_black(
    gaussians: Sequence[Tensor],
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    aperture: float = 0.0,
    focus: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """As `rasterize`, of Gaussians (means, scales, quats, opacities, sh) as the network orders them."""
    means, scales, quats, opacities, sh = gaussians
    black = torch.zeros(3, device=means.device)
    return rasterize(
        means, quats, scales, opacities, sh, viewmat, K, width, height, black, aperture=aperture, focus=focus
    )


def _project(
    camera_means: Tensor,  # [gaussians, 3]
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Means in pixels [gaussians, 2] and 2D covariances (xx, xy, yy) in pixels^2 [3, gaussians]."""
    x, y, z = camera_means.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    slope_x = torch.clamp(x / z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    slope_y = torch.clamp(y / z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    # Gaussians are the last dimension of what follows: PyTorch's loops run along it.
    right, down, forward = viewmat[:3, :3, None]
    row_u = (fx / z) * (right - slope_x * forward)  # rows of J W, [3, gaussians]
    row_v = (fy / z) * (down - slope_y * forward)
    axes = quaternions_to_matrices(quats).permute(1, 2, 0) * scales.T  # R S, [3, 3, gaussians]
    half_u = (row_u[:, None] * axes).sum(dim=0)  # [3, gaussians]
    half_v = (row_v[:, None] * axes).sum(dim=0)
    xx = (half_u * half_u).sum(dim=0) + EPS2D
    xy = (half_u * half_v).sum(dim=0)
    yy = (half_v * half_v).sum(dim=0) + EPS2D
    return centres, torch.stack([xx, xy, yy])


def _conics(covariances: Tensor) -> Tensor:
    """Inverses (xx, xy, yy) of 2D covariances [3, gaussians]: [gaussians, 3]."""
    xx, xy, yy = covariances
    return torch.stack([yy, -xy, xx], dim=-1) / _determinants(covariances)[:, None]


def _determinants(covariances: Tensor) -> Tensor:
    xx, xy, yy = covariances
    return xx * yy - xy * xy


def _defocus(covariances: Tensor, z: Tensor, K: Tensor, aperture: float, focus: float) -> tuple[Tensor, Tensor]:
    """2D covariances [3, gaussians] with the lens's blur, and the factor by which opacities fall, [gaussians]."""
    std = DISC_STD * aperture * (1 / focus - 1 / z)
    added = torch.stack([(K[0, 0] * std) ** 2, torch.zeros_like(std), (K[1, 1] * std) ** 2])
    blurred = covariances + added
    return blurred, (_determinants(covariances) / _determinants(blurred)).clamp(max=1).sqrt()


def _colours(sh: Tensor, means: Tensor, camera: Tensor) -> Tensor:
    """Colour of the Gaussians seen from the camera centre [3], [gaussians, 3]."""
    count = sh.shape[1]
    if count == 1:
        return torch.clamp_min(SH_0 * sh[:, 0] + 0.5, 0)
    basis = sh_basis(torch.nn.functional.normalize(means - camera, dim=-1), count)
    return torch.clamp_min((basis.T[:, None] * sh.permute(1, 2, 0)).sum(dim=0).T + 0.5, 0)


class _Composite(torch.autograd.Function):
    """Front-to-back compositing of the splats of some images.

    Returns values [images, height, width, 4] and the final transmittance [images, height, width].
    """

    @staticmethod
    def forward(ctx: Any, width: int, height: int, *splats: Tensor) -> tuple[Tensor, Tensor]:
        """splats: for each image centres [splats, 2], conics [splats, 3], opacities [splats] and values [splats, 4].

        The values are colour and z-depth.
        """
        arrays = [np.ascontiguousarray(part.detach().cpu().numpy()) for part in splats]
        ctx.images = map_in_threads(
            lambda index: _Image(*arrays[4 * index : 4 * index + 4], width=width, height=height),
            len(arrays) // 4,
            torch.get_num_threads(),
        )
        device = splats[0].device
        values = np.stack([image.values for image in ctx.images])
        transmittance = np.stack([image.transmittance for image in ctx.images])
        return torch.from_numpy(values).to(device), torch.from_numpy(transmittance).to(device)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients for centres, conics, opacities and values of each image."""
        device = gradients[0].device
        for_values, for_transmittance = (np.ascontiguousarray(part.cpu().numpy()) for part in gradients)
        found = map_in_threads(
            lambda index: ctx.images[index].gradients(for_values[index], for_transmittance[index]),
            len(ctx.images),
            torch.get_num_threads(),
        )
        return None, None, *(torch.from_numpy(part).to(device) for parts in found for part in parts)


class _Image:
    """An image composited, and what its gradients need."""

    def __init__(self, *splats: np.ndarray, width: int, height: int) -> None:
        """splats: centres, conics, opacities and values, as of `_Composite`."""
        self.splats = splats
        centres, conics, opacities, values = splats
        self.order = np.argsort(values[:, 3], kind="stable")
        self.values = np.zeros((height, width, 4), values.dtype)
        self.transmittance = np.ones((height, width), values.dtype)
        self.last = np.full((height, width), -1)
        _composite(centres, conics, opacities, values, self.order, self.values, self.transmittance, self.last)

    def gradients(self, for_values: np.ndarray, for_transmittance: np.ndarray) -> list[np.ndarray]:
        """Gradients for centres, conics, opacities and values."""
        centres, conics, opacities, values = self.splats
        found = [np.zeros_like(part) for part in self.splats]
        for_centres, for_conics, for_opacities, for_splats = found
        _composite_backward(
            *(centres, conics, opacities, values),
            *(self.order, self.transmittance, self.last),
            *(for_values, for_transmittance),
            *(for_centres, for_conics, for_opacities, for_splats),
        )
        return found


@_compiled
def _box(
    centres: np.ndarray, conics: np.ndarray, opacity: float, splat: int, width: int, height: int
) -> tuple[int, int, int, int]:
    """The bounding box of alpha >= MIN_ALPHA in pixels: first and end column, first and end row."""
    reach = 2 * np.log(opacity / MIN_ALPHA)
    if not reach > 0:
        return 0, 0, 0, 0
    determinant = conics[splat, 0] * conics[splat, 2] - conics[splat, 1] * conics[splat, 1]
    if not determinant > 0:
        return 0, 0, 0, 0
    half_x, half_y = np.sqrt(reach * conics[splat, 2] / determinant), np.sqrt(reach * conics[splat, 0] / determinant)
    x, y = centres[splat, 0] - 0.5, centres[splat, 1] - 0.5
    return (
        int(min(max(np.ceil(x - half_x), 0), width)),
        int(min(max(np.floor(x + half_x) + 1, 0), width)),
        int(min(max(np.ceil(y - half_y), 0), height)),
        int(min(max(np.floor(y + half_y) + 1, 0), height)),
    )


@_compiled
def _composite(
    centres: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    values: np.ndarray,
    order: np.ndarray,
    image: np.ndarray,
    transmittance: np.ndarray,
    last: np.ndarray,
) -> None:
    """Composite the splats in `order` into `image`. last: the position in `order` of each pixel's last splat.

    Until the end, the transmittance of a pixel that is finished is stored negated.
    """
    height, width = transmittance.shape
    for place in range(len(order)):
        splat = order[place]
        left, right, top, bottom = _box(centres, conics, opacities[splat], splat, width, height)
        xx, xy, yy, opacity = conics[splat, 0], conics[splat, 1], conics[splat, 2], opacities[splat]
        for row in range(top, bottom):
            dy = row + 0.5 - centres[splat, 1]
            for column in range(left, right):
                before = transmittance[row, column]
                if before < 0:
                    continue
                dx = column + 0.5 - centres[splat, 0]
                sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
                alpha = min(MAX_ALPHA, opacity * np.exp(-sigma))
                if alpha < MIN_ALPHA:
                    continue
                after = before * (1 - alpha)
                if after <= MIN_TRANSMITTANCE:
                    transmittance[row, column] = -before
                    continue
                weight = alpha * before
                for channel in range(4):
                    image[row, column, channel] += weight * values[splat, channel]
                transmittance[row, column] = after
                last[row, column] = place
    for row in range(height):
        for column in range(width):
            transmittance[row, column] = abs(transmittance[row, column])


@_compiled
def _composite_backward(
    centres: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    values: np.ndarray,
    order: np.ndarray,
    transmittance: np.ndarray,
    last: np.ndarray,
    image_gradient: np.ndarray,
    transmittance_gradient: np.ndarray,
    centre_gradients: np.ndarray,
    conic_gradients: np.ndarray,
    opacity_gradients: np.ndarray,
    value_gradients: np.ndarray,
) -> None:
    """Accumulate the gradients, back to front.

    For splat i of a pixel with values v_i, and g the gradient of the pixel's values:

        dL/dalpha_i = T_i d_i - B_i / (1 - alpha_i),    d_i = v_i . g,    B_i = sum_{j > i} d_j alpha_j T_j + T dL/dT.
    """
    height, width = transmittance.shape
    transmittance_behind = transmittance.astype(np.float64)  # T behind the current splat
    behind = transmittance_gradient * transmittance_behind  # B of the current splat
    for place in range(len(order) - 1, -1, -1):
        splat = order[place]
        left, right, top, bottom = _box(centres, conics, opacities[splat], splat, width, height)
        xx, xy, yy, opacity = conics[splat, 0], conics[splat, 1], conics[splat, 2], opacities[splat]
        for row in range(top, bottom):
            dy = row + 0.5 - centres[splat, 1]
            for column in range(left, right):
                if place > last[row, column]:
                    continue
                dx = column + 0.5 - centres[splat, 0]
                sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
                falloff = np.exp(-sigma)
                alpha = min(MAX_ALPHA, opacity * falloff)
                if alpha < MIN_ALPHA:
                    continue
                before = transmittance_behind[row, column] / (1 - alpha)
                dot = 0.0
                for channel in range(4):
                    value_gradients[splat, channel] += alpha * before * image_gradient[row, column, channel]
                    dot += values[splat, channel] * image_gradient[row, column, channel]
                alpha_gradient = before * dot - behind[row, column] / (1 - alpha)
                behind[row, column] += alpha * before * dot
                transmittance_behind[row, column] = before
                if opacity * falloff >= MAX_ALPHA:
                    continue
                opacity_gradients[splat] += falloff * alpha_gradient
                sigma_gradient = -alpha * alpha_gradient
                conic_gradients[splat, 0] += 0.5 * dx * dx * sigma_gradient
                conic_gradients[splat, 1] += dx * dy * sigma_gradient
                conic_gradients[splat, 2] += 0.5 * dy * dy * sigma_gradient
                centre_gradients[splat, 0] -= (xx * dx + xy * dy) * sigma_gradient
                centre_gradients[splat, 1] -= (yy * dy + xy * dx) * sigma_gradient
