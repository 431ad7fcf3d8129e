"""Is one prior of variances over all methods a good one, or would one per method be better?

python -m tools.proofs.priors [BASELINE ...]

Leaves out each seed of a baseline in turn and tests it against the others, once with the gate's prior over
all methods and once with a prior per method. Prints how often the p-value is below a level (two-sided; a rule
that holds what it promises has that level), and how wide tolerances are with a prior per method.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from econgs_bench.bench.gate.baseline import BaselineCell, read
from econgs_bench.bench.gate.quantities import QUANTITIES, Quantity
from econgs_bench.bench.gate.spread import prior, quantile, tail, variance_of
from econgs_bench.bench.gate.verdict import LEVEL
from tools.proofs.planted import ROOT

_TESTS = 240  # of a comparison of six methods on two scenes
LEVELS = (0.05, 0.01, 0.001, 0.0001)
QUALITY = [quantity for quantity in QUANTITIES.values() if quantity.kind != "time"]


def tests(cells: list[BaselineCell], quantity: Quantity, left: int) -> list[tuple[str, float, float]]:
    """Method, p-value and tolerance of each cell that seeds change, for one seed, with one prior for all."""
    changed = [
        (cell, scores)
        for cell in cells
        if variance_of(scores := [quantity.score(v) for v in cell.values[quantity.name] if v is not None])
    ]
    others = [np.delete(scores, left) for _, scores in changed]
    freedoms = [len(rest) - 1 for rest in others]
    shared = prior([variance_of(rest.tolist()) for rest in others], freedoms)
    out = []
    for (cell, values), rest, freedom in zip(changed, others, freedoms, strict=True):
        variance, whole = shared.moderated(variance_of(rest.tolist()), freedom)
        error = float(np.sqrt(variance * (1.0 + 1.0 / len(rest))))
        chance = 2.0 * tail(abs(values[left] - rest.mean()) / error, whole)
        out.append((cell.method, chance, quantile(LEVEL / _TESTS, whole) * error))
    return out


def main() -> None:
    """Print both rules for each baseline."""
    names = sys.argv[1:] or [ROOT / "tests" / f"{name}-baseline.json" for name in ("gate", "gate-full")]
    for path in map(Path, names):
        cells = read(path).cells
        by_method: dict[str, list[BaselineCell]] = defaultdict(list)
        for cell in cells:
            by_method[cell.method].append(cell)
        print(f"{path.name}\n| prior | " + " | ".join(f"p < {level:g}" for level in LEVELS) + " |")
        print("|---|" + "---|" * len(LEVELS))
        tolerances: dict[str, dict[str, list[float]]] = {}
        for name, groups in {"of all methods": [cells], "per method": list(by_method.values())}.items():
            done = [
                test
                for quantity in QUALITY
                for left in range(len(cells[0].seeds))
                for group in groups
                for test in tests(group, quantity, left)
            ]
            chances = np.array([chance for _, chance, _ in done])
            rates = " | ".join(f"{(chances < level).mean():.2%}" for level in LEVELS)
            print(f"| {name} ({len(done)} comparisons) | {rates} |")
            tolerances[name] = defaultdict(list)
            for method, _, tolerance in done:
                tolerances[name][method].append(np.log(tolerance))
        own, shared = tolerances["per method"], tolerances["of all methods"]
        ratios = (f"{method} {np.exp(np.mean(own[method]) - np.mean(shared[method])):.2f}" for method in own)
        print("tolerance per method / of all: " + ", ".join(ratios) + "\n")


if __name__ == "__main__":
    main()
