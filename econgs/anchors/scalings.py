"""Scalings of anchors: decoders get positive lengths, of which any numbers are optimised."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

Activation = Literal["exp", "sigmoid"]
_LARGEST = -1e-3
"""Logarithm of the largest scaling that a sigmoid begins with: it never reaches 1."""


def activated(raw: Tensor, activation: Activation) -> Tensor:
    """Scalings of the numbers that are optimised."""
    return raw.exp() if activation == "exp" else torch.sigmoid(raw)


def logarithms(raw: Tensor, activation: Activation) -> Tensor:
    """Logarithms of the scalings."""
    return raw if activation == "exp" else functional.logsigmoid(raw)


def of_logarithms(logs: Tensor, activation: Activation) -> Tensor:
    """The inverse of :func:`logarithms`; with a sigmoid, scalings end just below 1."""
    if activation == "exp":
        return logs
    below = logs.clamp_max(_LARGEST)
    return below - torch.log(-torch.expm1(below))
