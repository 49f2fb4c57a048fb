"""How well each pixel matches its neighbours at each candidate depth, by bilinear warping (plane sweep)."""

from torch import Tensor

from .epipolar_attention import correlate, pixel_table
from .geometry import Cameras, bilinear_pixels, scale_intrinsics
from .layers import fixed, repeat_views, to_tokens


def cost_volume(features: Tensor, candidates: Tensor, cameras: Cameras, neighbours: Tensor) -> Tensor:
    """Correlation of features [views, channels, h, w] with those of the neighbours, warped: [views, candidates, h, w].

    candidates: inverse depths [views, candidates, h, w]. neighbours: [views, n]; their costs are averaged.
    Interpolation and inner product commute, so each of the four pixels is correlated first and the four numbers are
    interpolated, not the features. Each view projects with its own intrinsics; the release projects into a neighbour
    with those of the view that looks, which are the same in all that it was trained on.
    """
    views, _, height, width = features.shape
    channels = fixed(features.shape[1])
    intrinsics = scale_intrinsics(cameras.intrinsics, height, width)
    tokens = to_tokens(features)
    queries = repeat_views(tokens * channels**-0.5, neighbours.shape[1])
    table = pixel_table(tokens)
    corners = bilinear_pixels(candidates, intrinsics, cameras.extrinsics, neighbours)
    costs = [weights * correlate(queries, table, rows) for rows, weights in corners]  # each [pairs, candidates, h * w]
    count = fixed(candidates.shape[1])
    mean = sum(costs[1:], start=costs[0]).reshape(views, -1, count, height * width).mean(1)
    return mean.reshape(-1, count, height, width)
