"""Spread of repetitions: few per cell, so that each cell borrows from all (Smyth 2004, "limma")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import digamma, polygamma, stdtr, stdtrit


@dataclass(frozen=True)
class Prior:
    """What the variances of all cells say about that of any one.

    Attributes:
        variance: typical variance of one repetition.
        freedom: degrees of freedom that it is worth; those of all cells together where the cells do not
            differ.
    """

    variance: float
    freedom: float

    def moderated(self, variance: float, freedom: int) -> tuple[float, float]:
        """Variance of a cell and its degrees of freedom, given the cell's own."""
        whole = self.freedom + freedom
        if whole == 0.0:
            return 0.0, 1.0
        return (self.freedom * self.variance + freedom * variance) / whole, whole


_EXACT = 1e-9
"""Standard deviation / mean under which values differ by the rounding of their arithmetic alone."""


def variance_of(values: Sequence[float]) -> float:
    """Sample variance of repetitions; 0 where they are equal but for rounding, which is no spread."""
    return without_rounding(float(np.var(values, ddof=1)), float(np.mean(values)))


def without_rounding(variance: float, mean: float) -> float:
    """A variance of values with this mean; 0 where the rounding of arithmetic makes it."""
    return variance if variance > (_EXACT * abs(mean)) ** 2 else 0.0


def prior(variances: Sequence[float], freedoms: Sequence[int]) -> Prior:
    """The scaled inverse chi-square prior that fits sample variances, by moments of their logarithms.

    Args:
        variances: one per cell; zeros, of numbers that seeds do not change, count nothing.
        freedoms: degrees of freedom of each.
    """
    pairs = [(s, d) for s, d in zip(variances, freedoms, strict=True) if s > 0.0 and d > 0]
    if not pairs:
        return Prior(0.0, 0.0)
    s, d = np.array(pairs, float).T
    logs = np.log(s) - digamma(d / 2) + np.log(d / 2)
    mean = float(logs.mean())
    excess = float(logs.var(ddof=1) - polygamma(1, d / 2).mean()) if len(pairs) > 1 else 0.0
    most = float(d.sum())  # that of a variance pooled over all cells
    if excess <= float(polygamma(1, most / 2)):
        return Prior(float((s * d).sum()) / most, most)
    half = math.exp(brentq(lambda x: float(polygamma(1, math.exp(x))) - excess, -20.0, 20.0))
    return Prior(math.exp(mean + float(digamma(half)) - math.log(half)), 2.0 * half)


def tail(statistic: float, freedom: float) -> float:
    """Probability of a larger value of Student's t."""
    return float(stdtr(min(freedom, 1e9), -statistic))


def quantile(probability: float, freedom: float) -> float:
    """The value that Student's t exceeds with a probability."""
    return -float(stdtrit(min(freedom, 1e9), probability))
