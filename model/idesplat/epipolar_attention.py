"""One warp-index epipolar attention layer: pixels attend to where their depth candidates fall in other views.

The releases multiply sparsely in a CUDA extension; here the same sums run over gathered rows (sparse_products.py).
"""

import torch
from torch import Tensor, nn

from ..common.gather_attention import GatherAttention, pixel_table
from ..common.layers import ConvFFN, repeat_views, static_dim, to_map, to_tokens
from ..common.unet import CostRegulariser
from .config import DPBUConfig, IDESplatConfig

# Keeps the renormalised product of probabilities away from zero.
EPSILON = 1e-10


class EpipolarAttention(nn.Module):
    """Warp-index epipolar attention (IDESplat, section 2)."""

    def __init__(self, network: IDESplatConfig, unit: DPBUConfig) -> None:
        super().__init__()
        channels, candidates = unit.channels, unit.candidates
        self.scale = channels**-0.5
        self.gather_attention = GatherAttention(channels * candidates, network.smallest_map(unit.scale))
        # Position embeddings of the candidates, for keys, values and scores.
        self.key_position = nn.Parameter(torch.zeros(candidates))
        self.value_position = nn.Parameter(torch.zeros(candidates))
        self.score_position = nn.Parameter(torch.zeros(candidates))
        for position in (self.key_position, self.value_position, self.score_position):
            nn.init.trunc_normal_(position, std=0.02)
        self.norm1 = nn.LayerNorm(channels)
        self.q_proj = nn.Linear(channels, channels)
        self.k_proj = nn.Linear(channels, channels)
        self.v_proj = nn.Linear(channels, channels)
        self.regulariser = CostRegulariser(candidates + 1, candidates, unit.unet)
        self.proj = nn.Linear(channels, channels)
        self.norm2 = nn.LayerNorm(channels)
        self.ffn = ConvFFN(channels, network.ffn_ratio, network.ffn_kernel)

    def forward(
        self, features: Tensor, coarse_inverse_depth: Tensor, rows: Tensor, prior: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Attend along the epipolar lines.

        features: [views, channels, h, w]; coarse_inverse_depth: what is known of the inverse depth, [views, 1, h, w].
        rows: warp indices [pairs, candidates, h * w], pairs = views * neighbours (geometry.nearest_pixels).
        prior: the previous layer's probabilities [pairs, candidates, h * w], which this layer's multiply.
        Returns features of the same shape and the probabilities.
        """
        views, _, height, width = features.shape
        neighbours = rows.shape[0] // views
        tokens = to_tokens(features)
        normed = self.norm1(tokens)
        queries = repeat_views(self.q_proj(normed) * self.scale, neighbours)
        scores = self.gather_attention.gathered_dot(
            queries, pixel_table(self.k_proj(normed)), rows
        )  # [pairs, candidates, h * w]
        scores = scores + queries.sum(-1)[:, None] * self.key_position[:, None] + self.score_position[:, None]

        known = torch.cat(
            [
                repeat_views(coarse_inverse_depth, neighbours),
                scores.reshape(-1, static_dim(scores.shape[1]), height, width),
            ],
            dim=1,
        )
        probability = self.regulariser(known, views).flatten(2)
        if prior is not None:  # depth probability boosting
            product = probability * prior
            probability = (product + EPSILON) / (product.sum(1, keepdim=True) + EPSILON)

        gathered = self.gather_attention.gathered_weighted_sum(
            probability, pixel_table(self.v_proj(normed)), rows
        )  # [pairs, h * w, channels]
        gathered = gathered + (probability * self.value_position[:, None]).sum(1)[..., None]
        tokens = tokens + self.proj(gathered.reshape(views, neighbours, -1, static_dim(gathered.shape[2])).mean(1))
        tokens = tokens + self.ffn(self.norm2(tokens), height, width)
        return to_map(tokens, height, width), probability
