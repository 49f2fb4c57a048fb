"""Compositing of splats in PyTorch's operations, for a GPU: each splat becomes a fragment for each pixel of its box.

Fragments are sorted by pixel and, within it, by depth. What a pixel sums front to back is then a cumulative sum over
its fragments, less what came before its first one.
"""

from typing import Any

import torch
from torch import Tensor

from ...runtime.rendering.types import MAX_ALPHA, MIN_ALPHA, MIN_LOG_TRANSMITTANCE


class CompositeFragments(torch.autograd.Function):
    """Front-to-back compositing of an image's splats; the results and gradients of `rasterizer.Composite`."""

    @staticmethod
    def forward(
        ctx: Any, width: int, height: int, centres: Tensor, conics: Tensor, opacities: Tensor, values: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The values [height, width, channels] and the final transmittance [height, width].

        centres: pixels, [splats, 2]. conics: (xx, xy, yy), [splats, 3]. opacities: [splats]. values: what is
        composited, of which the last channel is z-depth, [splats, channels].
        """
        splats, pixels = _fragments(centres, conics, opacities, values[:, -1], width, height)
        alphas = _alphas(centres, conics, opacities, splats, pixels, width)[3]
        starts, ends = _ranges(pixels, width * height)
        before, after = _log_transmittances(alphas, pixels, starts)
        seen = (after > MIN_LOG_TRANSMITTANCE).nonzero()[:, 0]
        splats, pixels, alphas = splats[seen], pixels[seen], alphas[seen]
        before, after = (part[seen].exp().to(alphas.dtype) for part in (before, after))
        image = values.new_zeros(width * height, values.shape[1])
        image.index_add_(0, pixels, (alphas * before)[:, None] * values[splats])
        starts, ends = _ranges(pixels, width * height)
        transmittance = torch.ones_like(image[:, 0])
        covered = (ends > starts).nonzero()[:, 0]
        transmittance[covered] = after[ends[covered] - 1]
        ctx.width = width
        ctx.save_for_backward(centres, conics, opacities, values, splats, pixels, before, ends, transmittance)
        return image.reshape(height, width, -1), transmittance.reshape(height, width)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients for centres, conics, opacities and values, by the formulas of `rasterizer._composite_backward`."""
        centres, conics, opacities, values, splats, pixels, before, ends, transmittance = ctx.saved_tensors
        for_image, for_transmittance = gradients[0].flatten(0, 1), gradients[1].flatten()
        dx, dy, falloff, alphas = _alphas(centres, conics, opacities, splats, pixels, ctx.width)
        for_fragments = for_image[pixels]
        dots = (values[splats] * for_fragments).sum(-1)
        weights = alphas * before
        composited = (weights * dots).double().cumsum(0)
        total = torch.cat([composited.new_zeros(1), composited])[ends]
        behind = (total + for_transmittance * transmittance)[pixels] - composited
        for_alphas = before * dots - behind.to(dots.dtype) / (1 - alphas)
        for_alphas = torch.where(opacities[splats] * falloff < MAX_ALPHA, for_alphas, 0)
        for_sigmas = -alphas * for_alphas
        xx, xy, yy = conics[splats].unbind(-1)
        parts = [
            -(xx * dx + xy * dy) * for_sigmas,
            -(yy * dy + xy * dx) * for_sigmas,
            0.5 * dx * dx * for_sigmas,
            dx * dy * for_sigmas,
            0.5 * dy * dy * for_sigmas,
            falloff * for_alphas,
        ]
        of_fragments = torch.cat([torch.stack(parts, dim=-1), weights[:, None] * for_fragments], dim=-1)
        summed = values.new_zeros(len(values), of_fragments.shape[1]).index_add_(0, splats, of_fragments)
        return None, None, summed[:, :2], summed[:, 2:5], summed[:, 5], summed[:, 6:]


def _fragments(
    centres: Tensor, conics: Tensor, opacities: Tensor, depth: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Splat and pixel of each fragment with alpha >= MIN_ALPHA, by pixel, then by depth, [fragments] each."""
    left, right, top, bottom = _boxes(centres, conics, opacities, width, height)
    order = depth.argsort(stable=True)
    counts = ((right - left) * (bottom - top))[order]
    splats = order.repeat_interleave(counts)
    within = torch.arange(len(splats), device=order.device) - (counts.cumsum(0) - counts).repeat_interleave(counts)
    columns = (right - left)[splats]
    pixels = (top[splats] + within // columns) * width + left[splats] + within % columns
    seen = (_alphas(centres, conics, opacities, splats, pixels, width)[3] >= MIN_ALPHA).nonzero()[:, 0]
    pixels, by_pixel = pixels[seen].int().sort(stable=True)
    return splats[seen][by_pixel], pixels.long()


def _boxes(
    centres: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The bounding boxes of alpha >= MIN_ALPHA in pixels: first and end column, first and end row, [splats] each."""
    xx, xy, yy = conics.unbind(-1)
    reach = 2 * (opacities / MIN_ALPHA).log()
    determinant = xx * yy - xy * xy
    shown = (reach > 0) & (determinant > 0)
    half_x, half_y = ((reach * part / determinant).sqrt() for part in (yy, xx))
    bounds = []
    for centre, half, size in ((centres[:, 0] - 0.5, half_x, width), (centres[:, 1] - 0.5, half_y, height)):
        for bound in ((centre - half).ceil(), (centre + half).floor() + 1):
            bounds.append(torch.where(shown, bound, 0).clamp(0, size).long())
    return bounds[0], bounds[1], bounds[2], bounds[3]


def _alphas(
    centres: Tensor, conics: Tensor, opacities: Tensor, splats: Tensor, pixels: Tensor, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of each fragment its offset from the splat's centre, dx and dy, the Gaussian's value there, and its alpha."""
    x, y = centres[splats].unbind(-1)
    dx, dy = pixels % width + 0.5 - x, pixels // width + 0.5 - y
    xx, xy, yy = conics[splats].unbind(-1)
    falloff = (-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy).exp()
    return dx, dy, falloff, (opacities[splats] * falloff).clamp(max=MAX_ALPHA)


def _ranges(pixels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The first and the end place of the fragments of each of `count` pixels, among fragments sorted by pixel."""
    ends = torch.searchsorted(pixels, torch.arange(count, device=pixels.device), right=True)
    return torch.cat([ends.new_zeros(1), ends[:-1]]), ends


def _log_transmittances(alphas: Tensor, pixels: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    """The logarithms of the transmittance before and behind each fragment.

    They are float64, since the sum goes over the fragments of all pixels.
    """
    logs = torch.log1p(-alphas.double())
    summed = logs.cumsum(0)
    after = summed - torch.cat([summed.new_zeros(1), summed])[starts][pixels]
    return after - logs, after
