"""Cutting token images into attention windows, and the mask that shifted windows need (Swin)."""

import torch
from torch import Tensor

from .layers import fixed

# Added to the score between tokens that only a cyclic shift brought together.
MASKED = -100.0


def split_windows(image: Tensor, rows: int, columns: int) -> Tensor:
    """[n, h, w, channels] -> [n, windows, rows * columns, channels]; h and w are multiples of rows and columns."""
    count, height, width, _ = image.shape
    channels = fixed(image.shape[3])
    image = image.reshape(-1, height // rows, rows, width // columns, columns, channels)
    return image.permute(0, 1, 3, 2, 4, 5).reshape(count, -1, rows * columns, channels)


def join_windows(windows: Tensor, height: int, width: int, rows: int, columns: int) -> Tensor:
    """The inverse of `split_windows`, from windows [..., rows * columns, channels] to [n, h, w, channels]."""
    channels = fixed(windows.shape[-1])
    image = windows.reshape(-1, height // rows, width // columns, rows, columns, channels)
    return image.permute(0, 1, 3, 2, 4, 5).reshape(-1, height, width, channels)


def shift_back(image: Tensor, rows: int, columns: int) -> Tensor:
    """[n, h, w, channels] moved cyclically up and left by the given numbers of pixels.

    torch.roll by a size that is only known at run time cannot be exported.
    """
    image = torch.cat([image[:, rows:], image[:, :rows]], dim=1)
    return torch.cat([image[:, :, columns:], image[:, :, :columns]], dim=2)


def region_mask(height: int, width: int, rows: int, columns: int, like: Tensor) -> Tensor:
    """What to add to the scores of windows shifted by half their size, [windows, rows * columns, rows * columns].

    In the last window of each axis the shift brings together tokens from opposite borders, which must not meet.
    """
    y = torch.arange(height, device=like.device)
    x = torch.arange(width, device=like.device)
    down = (y >= height - rows).to(like.dtype) + (y >= height - rows // 2).to(like.dtype)
    right = (x >= width - columns).to(like.dtype) + (x >= width - columns // 2).to(like.dtype)
    region = 3 * down[:, None] + right
    windows = split_windows(region[None, :, :, None], rows, columns)[0, :, :, 0]  # [windows, tokens]
    apart = windows[:, :, None] != windows[:, None, :]
    return MASKED * apart.to(like.dtype)
