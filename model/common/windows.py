"""Windows of attention, and the regions of shifted windows or their mask, as in Swin transformers (Liu et al. 2021)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .layers import static_dim

# Added to the score between tokens that only a cyclic shift brought together.
MASKED = -100.0
# Number of parts, down and across, of the windows in each group of regions.
HALVES = ((1, 1), (1, 2), (2, 1), (2, 2))


def split_windows(image: Tensor, rows: int, columns: int, shifted: bool = False) -> Tensor:
    """[n, h, w, channels] -> [n, windows, rows * columns, channels]; h and w are multiples of rows and columns.

    Shifted windows lie half a window further down and right, and wrap around at the opposite border.
    """
    count, height, width, _ = image.shape
    channels = static_dim(image.shape[3])
    if shifted:
        image = _roll(image, rows // 2, columns // 2)
    image = image.reshape(-1, height // rows, rows, width // columns, columns, channels)
    return image.permute(0, 1, 3, 2, 4, 5).reshape(count, -1, rows * columns, channels)


def join_windows(windows: Tensor, height: int, width: int, rows: int, columns: int, shifted: bool = False) -> Tensor:
    """The inverse of `split_windows`, from windows [..., rows * columns, channels] to [n, h, w, channels]."""
    channels = static_dim(windows.shape[-1])
    image = windows.reshape(-1, height // rows, width // columns, rows, columns, channels)
    image = image.permute(0, 1, 3, 2, 4, 5).reshape(-1, height, width, channels)
    return _roll(image, height - rows // 2, width - columns // 2) if shifted else image


def _roll(image: Tensor, up: int, left: int) -> Tensor:
    """[n, h, w, channels] rolled up and left by these numbers of pixels.

    torch.roll by a size that is only known at run time cannot be exported.
    """
    image = torch.cat([image[:, up:], image[:, :up]], dim=1)
    return torch.cat([image[:, :, left:], image[:, :, :left]], dim=2)


class Regions(NamedTuple):
    """The contiguous regions of windows [rows, columns] that are shifted by half, with `splits` windows a side.

    The shift brings tokens from opposite borders into the last window of each axis, whose halves must not attend to
    each other. Attention within regions computes what a mask over whole windows does, with 9/16 of the multiplications
    for two splits. Windows form four groups: neither axis in halves, columns, rows, both.
    """

    splits: int
    rows: int
    columns: int

    def split(self, windows: Tensor) -> list[Tensor]:
        """[n, windows, m * rows * columns, channels] -> four groups [regions, m * tokens of a region, channels]."""
        channels = static_dim(windows.shape[3])
        grid = windows.reshape(-1, self.splits, self.splits, windows.shape[2], channels)
        quarters = [part for rows in self._whole_and_halved(grid, 1) for part in self._whole_and_halved(rows, 2)]
        groups = []
        for (down, right), part in zip(HALVES, quarters, strict=True):
            rows, across = self.rows // down, self.columns // right * channels
            part = part.reshape(-1, windows.shape[2] // (self.rows * self.columns), down, rows, right, across)
            regions = part.permute(0, 2, 4, 1, 3, 5)
            groups.append(regions.reshape(-1, windows.shape[2] // (down * right), channels))
        return groups

    def _whole_and_halved(self, grid: Tensor, dim: int) -> tuple[Tensor, ...]:
        """The windows along an axis that stay whole, and the last."""
        return grid.split((self.splits - 1, 1), dim=dim)

    def join(self, groups: Sequence[Tensor]) -> Tensor:
        """The inverse of `split`, for m = 1."""
        channels, tokens = static_dim(groups[0].shape[2]), self.rows * self.columns
        parts = []
        for (down, right), regions in zip(HALVES, groups, strict=True):
            across = self.columns // right * channels
            part = regions.reshape(-1, down, right, self.rows // down, across).transpose(2, 3)
            shape = (1 if down > 1 else self.splits - 1), (1 if right > 1 else self.splits - 1)
            parts.append(part.reshape(-1, *shape, tokens, channels))
        upper, lower = torch.cat(parts[:2], dim=2), torch.cat(parts[2:], dim=2)
        return torch.cat([upper, lower], dim=1).flatten(1, 2)


def region_mask(height: int, width: int, rows: int, columns: int, like: Tensor) -> Tensor:
    """The mask added to the scores of windows shifted by half their size, [windows, rows * columns, rows * columns].

    In the last window of each axis the shift brings together tokens from opposite borders, which must not attend to
    each other.
    """
    y = torch.arange(height, device=like.device)
    x = torch.arange(width, device=like.device)
    down = (y >= height - rows).to(like.dtype) + (y >= height - rows // 2).to(like.dtype)
    right = (x >= width - columns).to(like.dtype) + (x >= width - columns // 2).to(like.dtype)
    region = 3 * down[:, None] + right
    windows = split_windows(region[None, :, :, None], rows, columns)[0, :, :, 0]  # [windows, tokens]
    apart = windows[:, :, None] != windows[:, None, :]
    return MASKED * apart.to(like.dtype)
