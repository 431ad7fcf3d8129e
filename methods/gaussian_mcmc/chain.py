"""Moves of the chain: copies that look like their source, and noise on positions (3DGS-MCMC, section 4)."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from econgs_bench.methods.gaussian_splatting.densify import rotate

MOST_COPIES = 50
"""Of one Gaussian at one event; the binomials of more cancel."""
GATE = 100.0
"""How steeply noise falls with opacity."""
_OPAQUE = 1.0 - 1e-7


@cache
def _signed_binomials() -> Tensor:
    """(N + 1, N) float64, N = MOST_COPIES: (-1)^(j+1) C(n, j) / sqrt(j) for n from 0 and j from 1."""
    rows = [
        [(-1) ** (j + 1) * math.comb(n, j) / math.sqrt(j) for j in range(1, MOST_COPIES + 1)]
        for n in range(MOST_COPIES + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


def shared_opacity(opacities: Tensor, copies: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Opacity of each of N coincident copies that look like one Gaussian, and the factor on its scales.

    At the centre, (1 - o')^N = 1 - o. Along a line through it, the integral of the copies' joint opacity
    1 - (1 - o' g)^N, with g the Gaussian, equals that of o g: integrated, the binomial theorem gives
    D = sum over j of (-1)^(j+1) C(N, j) o'^j / sqrt(j), and the factor is o / D (equation 9 of the paper,
    whose double sum this is, summed over i).

    Args:
        opacities: (M,) o, of the one Gaussian.
        copies: (M,) N, whole numbers of at least 1, the source included; more than 50 count as 50.
        least: bound of o' from below, which the factor takes into account.

    Returns:
        (M,) o' and (M,) factors, float64.
    """
    n = copies.clamp(max=MOST_COPIES)
    o = opacities.double().clamp(max=_OPAQUE)
    shared = -torch.expm1(torch.log1p(-o) / n)
    shared = shared.clamp(min=least)
    powers = shared[:, None] ** torch.arange(1, MOST_COPIES + 1, device=o.device)
    integral = (_signed_binomials().to(o.device)[n] * powers).sum(1)
    return shared, o / integral


def noise(
    log_scales: Tensor, quats: Tensor, logits: Tensor, dead_opacity: float, generator: torch.Generator
) -> Tensor:
    """(N, 3) normal noise, of covariance S = the square of each Gaussian's own, for the transparent only.

    Args:
        log_scales: (N, 3).
        quats: (N, 4).
        logits: (N,) opacities before the sigmoid.
        dead_opacity: where the gate is one half.
        generator: CPU generator.
    """
    gate = torch.sigmoid(GATE * (dead_opacity - logits.sigmoid()))
    drawn = torch.randn(log_scales.shape, generator=generator).to(log_scales)
    back = quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])
    return rotate(quats, (2.0 * log_scales).exp() * rotate(back, drawn * gate[:, None]))
