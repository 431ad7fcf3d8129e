"""TF embeddings as biases: a group of few scenes needs no embedding to tell them apart."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from econgs.anchors.decoders import Decoders


@torch.no_grad()
def fold_embeddings(decoders: Decoders, embeddings: Sequence[Tensor]) -> tuple[Decoders, list[Tensor]]:
    """The same networks for n scenes with embeddings of length n - 1.

    All that a first layer sees of an embedding e of length E is W e, a bias. The first scene's becomes part
    of the layer's own bias; each further scene gets a column with its difference from that, and an embedding
    that is zero but for this column. Its size is chosen so that the column is no larger in any row than the
    row's other weights are: rows are stored with one scale.

    Args:
        decoders: with embeddings of length E.
        embeddings: (E,) of each scene.

    Returns:
        Networks and embeddings that decode the same; those given if n - 1 is not less than E.
    """
    many = len(embeddings) - 1
    if many >= decoders.embedding:
        return decoders, list(embeddings)
    reference, *others = embeddings
    made = Decoders(
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
        network = made.network(name)
        network.first_weight[:, :width] = first[:, :width]
        network.first_bias.copy_(bias + weight @ reference)
        network.second_weight.copy_(second)
        network.second_bias.copy_(second_bias)
        largest = first[:, :width].abs().amax(1).clamp_min(1e-12)
        for j, column in enumerate(columns[name]):
            sizes[j] = max(sizes[j], float((column.abs() / largest).max()))
    for name, found in columns.items():
        for j, column in enumerate(found):
            made.network(name).first_weight[:, made.network(name).first_weight.shape[1] - many + j] = (
                column / sizes[j]
            )
    folded = [reference.new_zeros(many)]
    for j, size in enumerate(sizes):
        embedding = reference.new_zeros(many)
        embedding[j] = size
        folded.append(embedding)
    return made, folded
