"""Offset colors alone, for a regulariser."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.econgs.anchors.decoders import OFFSET_COLORS, Decoders
from econgs_bench.econgs.anchors.shading import unit


def offset_colors(
    decoders: Decoders, anchors: Tensor, features: Tensor, embedding: Tensor, eye: Tensor
) -> Tensor:
    """(N, 3, K) offset colors of all Gaussians of these anchors, also culled ones.

    Arguments as in :func:`.econgs.anchors.decode.decode`. Gradients reach features, embedding and the weights
    of F_s.
    """
    many = decoders.offsets
    if decoders.storage == "explicit":
        begin = decoders.features + 3 * many
        raw = features[:, begin : begin + 7 * many].reshape(len(features), many, 7)[..., :3].transpose(1, 2)
    else:
        inputs = features[:, : decoders.features]
        if decoders.view_direction:
            inputs = torch.cat([inputs, unit(anchors - eye)], dim=1)
        width = inputs.shape[1]
        first, bias, second, second_bias = decoders.network("shading").tensors()
        hidden = torch.relu(torch.addmm(bias + first[:, width:] @ embedding, inputs, first[:, :width].T))
        rows = 3 * many  # attribute * K + offset: the color comes first
        raw = torch.addmm(second_bias[:rows], hidden, second[:rows].T).view(len(features), 3, many)
    return OFFSET_COLORS[decoders.offset_color](raw)
