"""The power of a gate: the smallest losses that a run shows, by its number of seeds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from econgs_bench.bench.gate.baseline import Baseline
from econgs_bench.bench.gate.quantities import QUANTITIES, Quantity
from econgs_bench.bench.gate.verdict import Scope, tolerances
from econgs_bench.reports.style import counted

SEEDS = (1, 3)
_SCOPES: tuple[Scope, ...] = ("a scene", "a method's mean", "a view")


def power(
    baseline: Baseline, seeds: Sequence[int] = SEEDS, *, times: bool = True
) -> dict[tuple[str, Scope], dict[int, list[float]]]:
    """Name of a quantity and what it is of -> number of seeds -> the loss of each comparison (score).

    A loss beyond it is a finding.
    """
    found: dict[tuple[str, Scope], dict[int, list[float]]] = defaultdict(lambda: {n: [] for n in seeds})
    for number in seeds:
        for scope, quantity, loss in tolerances(baseline, number, times=times):
            found[quantity.name, scope][number].append(loss)
    return {
        (name, scope): found[name, scope]
        for name in QUANTITIES
        for scope in _SCOPES
        if (name, scope) in found
    }


def markdown(baseline: Baseline, seeds: Sequence[int] = SEEDS, *, times: bool = True) -> str:
    """A table: median and largest loss over comparisons, by the number of seeds of the run."""
    heads = [f"{counted(number, 'seed')}: {what}" for number in seeds for what in ("median", "largest")]
    lines = [
        "| quantity | of | comparisons | " + " | ".join(heads) + " |",
        "|---|---|---|" + "---|" * len(heads),
    ]
    for (name, scope), losses in power(baseline, seeds, times=times).items():
        quantity = QUANTITIES[name]
        title = "1 - SSIM" if name == "ssim" else quantity.title
        count = len(losses[seeds[0]])
        amounts = [
            _amount(quantity, float(loss))
            for number in seeds
            for loss in (np.median(losses[number]), max(losses[number]))
        ]
        lines.append(f"| {title} | {scope} | {count} | " + " | ".join(amounts) + " |")
    return "\n".join(lines)


def _amount(quantity: Quantity, loss: float) -> str:
    if quantity.scale == "linear":
        return f"{loss:.2f}"
    return quantity.change(loss)
