"""Which leads of a page are significant: all of them are one family and are corrected together."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from econgs_bench.reports.style import counted

LEVEL = 0.05
"""Probability that a page declares any lead of methods that are equal."""


@dataclass(frozen=True)
class Family:
    """The leads that a page reports: of its answers, races and rate-distortion curves.

    Holm's step-down correction (1979, Scand. J. Statist. 6, 65-70) keeps the probability that any of them is
    declared without cause at :data:`LEVEL`, whatever their dependence. A lead is on all rivals, so its
    p-value is the largest of those against each (intersection-union test; Berger 1982, Technometrics 24,
    295-300). These are two-sided, since the data pick the leader (Gutmann & Maymin 1987, Ann. Statist. 15,
    456-461).

    Attributes:
        p_values: of the leads that have one, in ascending order.
    """

    p_values: tuple[float, ...] = ()

    @classmethod
    def of(cls, p_values: Iterable[float | None]) -> Family:
        """Of leads; those without a p-value are not tested, and do not count."""
        return cls(tuple(sorted(p for p in p_values if p is not None)))

    def corrected(self, p: float | None) -> float | None:
        """The least level of the family at which a lead with this p-value is significant."""
        if p is None:
            return None
        ahead = self.p_values[: bisect_left(self.p_values, p)]
        left = range(len(self.p_values), 0, -1)
        steps = [count * one for count, one in zip(left, ahead, strict=False)]
        return min(1.0, max(*steps, max(1, len(self.p_values) - len(ahead)) * p, 0.0))

    def significant(self, p: float | None) -> bool:
        """Whether a lead is significant; one that is not tested is not."""
        corrected = self.corrected(p)
        return corrected is not None and corrected <= LEVEL

    @property
    def size(self) -> str:
        """As "41 leads of this page"."""
        return f"{counted(len(self.p_values), 'lead')} of this page"

    def verdict(self, p: float | None) -> str:
        """On a lead, for people; "" where it is not tested."""
        if p is None:
            return ""
        return f"{'' if self.significant(p) else 'ahead, not '}significant among {self.size}"

    def text(self, p: float | None) -> str:
        """A p-value and, in parentheses, the corrected one; "" where there is none."""
        corrected = self.corrected(p)
        return "" if p is None or corrected is None else f"{_digits(p)} ({_digits(corrected)})"


def largest(p_values: Sequence[float | None]) -> float | None:
    """The p-value of a lead on all rivals; None without rivals, or where the lead on one is not tested."""
    known = [p for p in p_values if p is not None]
    return max(known) if known and len(known) == len(p_values) else None


def _digits(p: float) -> str:
    return f"{p:.3f}" if p >= 0.0005 else "< 0.001"
