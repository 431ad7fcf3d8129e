"""Does the gate raise a false alarm? Repetitions of one state with other seeds, judged by a baseline of five.

python -m tests.proofs.repetitions [--store DIR] [--seeds 45] [--baselines 20]

Runs the suite `gate` with each seed into the store (what is finished stays), takes the seeds 0 to 4 as
baseline, and judges every other seed alone. Nothing has changed, so each alarm is false: none of n bounds
their rate at 3 / n (95 %). The same is repeated with baselines of five random seeds; these share runs, so
they bound nothing, but show what a baseline that came out badly would do. Quality and sizes only: times are
of shared machines.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections import Counter
from collections.abc import Collection
from pathlib import Path

import numpy as np

from bench.gate.baseline import FORMAT, Baseline, Change, cell_of, sorted_cells
from bench.gate.cells import Cell, Key, cells_of
from bench.gate.quantities import QUANTITIES
from bench.gate.spread import prior, quantile
from bench.gate.verdict import LEVEL, Verdict, compare
from bench.store import Store
from bench.tables import build_tables

BASE = 5
"""Seeds of a baseline."""


def part(cells: dict[Key, Cell], seeds: Collection[int]) -> dict[Key, Cell]:
    """The cells with some of their seeds."""

    def some(values: dict) -> dict:
        return {seed: value for seed, value in values.items() if seed in seeds}

    return {
        key: Cell(key, cell.version, cell.processor, some(cell.values), some(cell.views), some(cell.models))
        for key, cell in cells.items()
    }


def baseline_of(cells: dict[Key, Cell], seeds: Collection[int]) -> Baseline:
    """A baseline in memory."""
    change = Change(date="", reason="repetitions", version="", commit=None)
    made = sorted_cells(cell_of(cell) for cell in part(cells, seeds).values())
    return Baseline(format=FORMAT, changes=[change], environment={}, cells=made)


def judge(cells: dict[Key, Cell], base: Collection[int], seed: int) -> Verdict:
    """The verdict on one seed."""
    return compare(baseline_of(cells, base), part(cells, [seed]), times=False)


def main() -> None:
    """Run what lacks, then print the counts and what the gate is able to see."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("out/repetitions"))
    parser.add_argument("--seeds", type=int, default=45)
    parser.add_argument("--baselines", type=int, default=20)
    options = parser.parse_args()
    seeds = list(range(options.seeds))
    flags = [text for seed in seeds for text in ("--seed", str(seed))]
    command = [
        sys.executable,
        "-m",
        "bench",
        "run",
        "gate",
        *flags,
        "--out",
        str(options.store),
        "--no-report",
    ]
    subprocess.run(command, check=True)
    store = Store(options.store)
    cells = cells_of(store, build_tables(store, write=False))
    print_alarms("seeds 0 to 4", cells, seeds[:BASE], seeds[BASE:])
    rng = np.random.default_rng(0)
    alarms = total = 0
    for _ in range(options.baselines):
        base = sorted(map(int, rng.choice(seeds, BASE, replace=False)))
        others = [seed for seed in seeds if seed not in base]
        alarms += sum(judge(cells, base, seed).code != 0 for seed in others)
        total += len(others)
    print(
        f"{options.baselines} random baselines: {alarms} alarms in {total} comparisons ({alarms / total:.2%})"
    )
    print_tolerances(cells, seeds[:BASE], seeds[BASE:])


def print_alarms(name: str, cells: dict[Key, Cell], base: list[int], others: list[int]) -> None:
    """Alarms and gains of a baseline, with what raised them."""
    verdicts = {seed: judge(cells, base, seed) for seed in others}
    kinds = Counter(kind for v in verdicts.values() for kind in {f.kind for f in v.of("worse", "better")})
    tests = next(iter(verdicts.values())).tests
    print(
        f"baseline of {name}: {kinds['worse']} of {len(others)} repetitions raise alarms, "
        f"{kinds['better']} gains"
    )
    print(f"({tests} comparisons each; without an alarm their rate is under {3 / len(others):.1%})")
    for seed, verdict in verdicts.items():
        for finding in verdict.of("worse", "better"):
            print(f"  seed {seed}: {finding.kind} {finding.cell}: {finding.text}")


def print_tolerances(cells: dict[Key, Cell], base: list[int], others: list[int]) -> None:
    """By method: the largest difference that the seeds 5 and later show, and half of what the gate needs."""
    methods = dict.fromkeys(key.method for key in cells)
    names = ("psnr", "ssim", "flip", "size_bytes", "primitives")
    print("| method | " + " | ".join(f"{QUANTITIES[name].title}: seeds, alarm" for name in names) + " |")
    print("|" + "---|" * (len(names) + 1))
    for method in methods:
        row = [method]
        for name in names:
            quantity = QUANTITIES[name]
            spreads, needs = [], []
            for key, cell in cells.items():
                if key.method == method:
                    scores = [quantity.score(cell.values[seed][name]) for seed in others]
                    spreads.append(float(np.std(scores, ddof=1)))
                    needs.append(smallest_loss(cells, key, name, base, others[0]))
            unit = " dB" if quantity.scale == "linear" else ""
            row.append(
                f"{quantity.change(float(np.mean(spreads))).lstrip('+-')}{unit}, "
                f"{quantity.change(float(np.mean(needs))).lstrip('+-')}{unit}"
            )
        print("| " + " | ".join(row) + " |", flush=True)


def smallest_loss(cells: dict[Key, Cell], key: Key, name: str, base: list[int], seed: int) -> float:
    """The least loss of score in one result of one seed that the gate finds, from the baseline's mean."""
    quantity = QUANTITIES[name]
    tests = judge(cells, base, seed).tests
    scores = {other: [quantity.score(cell.values[s][name]) for s in base] for other, cell in cells.items()}
    variances = {other: float(np.var(values, ddof=1)) for other, values in scores.items()}
    shared = prior(list(variances.values()), [len(base) - 1] * len(variances))
    variance, freedom = shared.moderated(variances[key], len(base) - 1)
    return quantile(LEVEL / tests, freedom) * float(np.sqrt(variance * (1 / len(base) + 1)))


if __name__ == "__main__":
    main()
