"""Quality against cost, relative to a reference method: the chart that decides."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.reports.effects import Effect, effect
from econgs_bench.reports.sections.answers.contest import Contest

REFERENCE = "3dgs"


@dataclass(frozen=True)
class Mark:
    """A method relative to the reference.

    Attributes:
        method: its name.
        cost: logarithm of the ratio of the cost.
        quality: difference of PSNR in dB.
    """

    method: str
    cost: Effect
    quality: Effect


def reference(contest: Contest) -> str:
    """:data:`REFERENCE` if its pictures are compared, else the first method whose are."""
    names = list(contest.values("psnr").own) or contest.methods
    return REFERENCE if REFERENCE in names else names[0]


def marks(contest: Contest, column: str) -> list[Mark]:
    """All ranked methods but the reference, on the datasets where all have the cost; none if it lacks that.

    Args:
        contest: the methods and rows.
        column: of the cost; its values are positive.
    """
    costs, psnr = contest.values(column).cells, contest.values("psnr").cells
    base = reference(contest)
    all_marks = []
    for method in contest.methods:
        if method == base or any(name not in values for name in (method, base) for values in (costs, psnr)):
            continue
        cost = effect(costs[method], costs[base], 1, ratio=True)
        quality = effect(
            {dataset: psnr[method][dataset] for dataset in costs[method] if dataset in psnr[method]},
            psnr[base],
            1,
            ratio=False,
        )
        if cost is not None and quality is not None:
            all_marks.append(Mark(method, cost, quality))
    return all_marks
