"""TF embeddings as biases: few scenes need only short embeddings."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from econgs_bench.econgs.anchors.decoders import Decoders


@torch.no_grad()
def fold_embeddings(decoders: Decoders, embeddings: Sequence[Tensor]) -> tuple[Decoders, list[Tensor]]:
    """The same networks for n scenes with embeddings of length n - 1.

    An embedding e of length E enters a first layer as W e, a bias. The first scene's becomes part
    of the layer's own bias; each further scene gets a column with its difference from that, and an embedding
    that is zero but for this column. Its size makes the column no larger in any row than the row's
    other weights: a stored row has one scale.

    Args:
        decoders: networks for embeddings of length E.
        embeddings: (E,) embedding of each scene.

    Returns:
        Networks and embeddings that decode the same; the arguments themselves if n - 1 >= E.
    """
    many = len(embeddings) - 1
    if many >= decoders.embedding:
        return decoders, list(embeddings)
    reference, *others = embeddings
    networks = Decoders(
        decoders.features,
        decoders.offsets,
        many,
        hidden=decoders.hidden,
        view_direction=decoders.view_direction,
        offset_color=decoders.offset_color,
        storage=decoders.storage,
    ).to(reference.device)
    sizes = [1e-12] * many
    columns: dict[str, list[Tensor]] = {}
    for name in decoders.names:
        first, bias, second, second_bias = decoders.network(name).tensors()
        width = first.shape[1] - decoders.embedding
        weight = first[:, width:]
        columns[name] = [weight @ (other - reference) for other in others]
        network = networks.network(name)
        network.first_weight[:, :width] = first[:, :width]
        network.first_bias.copy_(bias + weight @ reference)
        network.second_weight.copy_(second)
        network.second_bias.copy_(second_bias)
        largest = first[:, :width].abs().amax(1).clamp_min(1e-12)
        for j, column in enumerate(columns[name]):
            sizes[j] = max(sizes[j], float((column.abs() / largest).max()))
    for name, additions in columns.items():
        weight = networks.network(name).first_weight
        for j, addition in enumerate(additions):
            weight[:, weight.shape[1] - many + j] = addition / sizes[j]
    short = [reference.new_zeros(many)]
    for j, size in enumerate(sizes):
        embedding = reference.new_zeros(many)
        embedding[j] = size
        short.append(embedding)
    return networks, short
