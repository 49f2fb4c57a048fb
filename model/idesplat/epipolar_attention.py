"""Warp-index epipolar attention (WIEA): pixels attend to the projections of their depth candidates in other views.

IDESplat, section 2. With the warp index I(x, m) of pixel x at candidate m (geometry.warp_indices), the correlation is

    C(x, m) = <Q(x), K(I(x, m))>,

with queries Q and keys K projected from the features of both views. A 2D U-Net refines C, and

    A(x, m) = softmax_m(U(C)(x, m))

is the layer's depth probability. The releases compute C, and the sum of values V weighted by A, as sparse matrix
products in a CUDA extension; here the same sums run over gathered rows (common/gather_attention.py).
"""

import torch
from torch import Tensor, nn

from ..common.gather_attention import GatherAttention, pixel_table
from ..common.layers import ConvFFN, MapLayerNorm, repeat_views, static_dim, to_map, to_tokens
from ..common.unet import CostRegulariser
from .config import DPBUConfig, IDESplatConfig

# Keeps the normalised product of probabilities away from zero.
EPSILON = 1e-10


class EpipolarAttention(nn.Module):
    """One WIEA layer, with the position embeddings and the feed-forward layer of the releases."""

    def __init__(self, network: IDESplatConfig, unit: DPBUConfig) -> None:
        super().__init__()
        channels, candidates = unit.channels, unit.candidates
        self.scale = channels**-0.5
        self.gather_attention = GatherAttention(channels * candidates, network.smallest_map(unit.scale))
        # Position embeddings of the candidates: one number each, added to keys, values and scores.
        self.key_position = nn.Parameter(torch.zeros(candidates))
        self.value_position = nn.Parameter(torch.zeros(candidates))
        self.score_position = nn.Parameter(torch.zeros(candidates))
        for position in (self.key_position, self.value_position, self.score_position):
            nn.init.trunc_normal_(position, std=0.02)
        self.norm1 = MapLayerNorm(channels)
        self.q_proj = nn.Linear(channels, channels)
        self.k_proj = nn.Linear(channels, channels)
        self.v_proj = nn.Linear(channels, channels)
        self.regulariser = CostRegulariser(candidates + 1, candidates, unit.unet)
        self.proj = nn.Linear(channels, channels)
        self.norm2 = MapLayerNorm(channels)
        self.ffn = ConvFFN(channels, network.ffn_ratio, network.ffn_kernel)

    def forward(
        self, features: Tensor, coarse_inverse_depth: Tensor, rows: Tensor, prior: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Attend along the epipolar lines; returns features of the same shape and probabilities of the prior's shape.

        features: [views, channels, h, w]. coarse_inverse_depth: an input of the U-Net, [views, 1, h, w].
        rows: warp indices [pairs, candidates, h * w], pairs = views * neighbours (geometry.warp_indices).
        prior: P_{m-1}, the previous layer's probability [pairs, candidates, h * w]; None (1) in a DPBU's first layer.
        """
        views, _, height, width = features.shape
        neighbours = rows.shape[0] // views
        normed = to_tokens(self.norm1(features))
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
        if prior is not None:  # P_m = Norm(P_{m-1} * A_m), IDESplat, section 2
            product = probability * prior
            probability = (product + EPSILON) / (product.sum(1, keepdim=True) + EPSILON)

        gathered = self.gather_attention.gathered_weighted_sum(
            probability, pixel_table(self.v_proj(normed)), rows
        )  # [pairs, h * w, channels]
        gathered = gathered + (probability * self.value_position[:, None]).sum(1)[..., None]
        gathered = gathered.reshape(views, neighbours, -1, static_dim(gathered.shape[2])).mean(1)
        features = features + to_map(self.proj(gathered), height, width)
        return features + self.ffn(self.norm2(features)), probability
