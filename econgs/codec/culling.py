"""Which Gaussians decoders cull, in whole numbers: writer and reader of a stream agree on every machine.

Decoders that do not see the viewing direction cull the same Gaussians in every view. Their offsets are never
used, so a stream does without them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from econgs_bench.econgs.codec.arrays import Arrays
from econgs_bench.econgs.codec.symbols import Present

Whole = NDArray[np.int64]
_BITS = 16
_WEIGHT_LIMIT = 1 << 23
_VALUE_LIMIT = 1 << 28
MOST_INPUTS = 512
"""Products of a value and a weight, this many of them, stay below 2^60."""
MARGIN = 1 << (_BITS - 7)
"""Gaussians whose opacity before activation is this little below 0 keep their offsets: fractions were cut."""


def kept_offsets(decoders: Arrays, features: NDArray[np.float32], parameters: Arrays) -> Present:
    """(N, K) whether the network ``opacity`` may show a Gaussian.

    Args:
        decoders: weights by name, as the stream holds them.
        features: (N, F), as the stream holds them.
        parameters: of the scene; ``embedding`` (E,) is the rest of the network's inputs.

    Raises:
        ValueError: there is no such network, or it has other sizes.
    """
    try:
        first, bias, second, second_bias = (
            decoders[f"opacity.{name}"]
            for name in ("first_weight", "first_bias", "second_weight", "second_bias")
        )
        embedding = parameters["embedding"]
    except KeyError as missing:
        raise ValueError(f"no {missing}, by which Gaussians are culled") from None
    shapes = [one.ndim for one in (first, bias, second, second_bias, embedding)]
    inputs, width = features.shape[1] + embedding.size, len(bias) if bias.ndim else 0
    if (
        shapes != [2, 1, 2, 1, 1]
        or first.shape != (width, inputs)
        or second.shape != (len(second_bias), width)
        or max(inputs, width) > MOST_INPUTS
    ):
        raise ValueError("the network that culls Gaussians has another size than the attributes")
    rows = np.broadcast_to(_whole(embedding, _VALUE_LIMIT), (len(features), embedding.size))
    values = np.concatenate([_whole(features, _VALUE_LIMIT), rows], 1)
    hidden = _layer(values, first, bias).clip(0, _VALUE_LIMIT)
    kept: Present = _layer(hidden, second, second_bias) > -MARGIN
    return kept


def _layer(values: Whole, weight: ArrayLike, bias: ArrayLike) -> Whole:
    products: Whole = values @ _whole(weight, _WEIGHT_LIMIT).T
    sums: Whole = (products >> _BITS) + _whole(bias, _VALUE_LIMIT)
    return sums


def _whole(values: ArrayLike, limit: int) -> Whole:
    """Whole numbers of 2⁻¹⁶, clamped."""
    exact = np.nan_to_num(np.asarray(values, np.float64) * (1 << _BITS))
    whole: Whole = np.rint(exact.clip(-limit, limit)).astype(np.int64)
    return whole
