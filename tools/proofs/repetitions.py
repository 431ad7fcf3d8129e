"""Does the gate raise a false alarm? Repetitions of one state with other seeds, judged by a baseline of five.

python -m tools.proofs.repetitions [--store DIR] [--seeds 45] [--method NAME ...] [--baselines 20]
python -m tools.proofs.repetitions --seeds 0        judge what repetitions.csv holds

Runs the suite `gate` into the store with each seed that repetitions.csv lacks, and writes the values of all
there. Takes the seeds 0 to 4 as baseline, and judges every other seed of a method alone. Nothing has changed,
so each alarm is false: none of n bounds their rate at 1 - 0.05^(1/n) (95 %). The same is repeated with
baselines of five random seeds; these share runs, so they bound nothing, but show what a baseline that came
out badly would do. Quality and sizes only: times are of shared machines.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.bench.gate.baseline import FORMAT, Baseline, Change, cell_of, sorted_cells
from econgs_bench.bench.gate.baseline import read as read_baseline
from econgs_bench.bench.gate.cells import VIEW_METRIC, Cell, Key, cells_of
from econgs_bench.bench.gate.power import power
from econgs_bench.bench.gate.quantities import QUANTITIES
from econgs_bench.bench.gate.verdict import Finding, Verdict, compare
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.methods.registry import Registry

VALUES = Path(__file__).with_name("repetitions.csv")
"""Quantities of every repetition, and the PSNR of each view; older versions of a method do not count."""
PROJECT = Path(__file__).parents[2] / "tests" / "gate-baseline.json"
_NUMBERS = [name for name, quantity in QUANTITIES.items() if quantity.kind != "time"]
_VIEW = f"{VIEW_METRIC} "
BASE = 5
"""Seeds of a baseline."""
SEED_COUNTS = ((5, 1), (5, 3), (10, 1), (10, 3), (20, 1), (20, 3), (20, 5))
"""Seeds of a baseline and of a run whose smallest losses are printed."""
Cells = dict[Key, Cell]


def part(cells: Cells, seeds: Collection[int], method: str = "") -> Cells:
    """The cells (of a method) with some of their seeds."""

    def some(values: dict[int, Any]) -> dict[int, Any]:
        return {seed: value for seed, value in values.items() if seed in seeds}

    return {
        key: Cell(
            key,
            cell.version,
            cell.processor,
            some(cell.values),
            some(cell.views),
            some(cell.models),
            options=some(cell.options),
        )
        for key, cell in cells.items()
        if method in ("", key.method)
    }


def baseline_of(cells: Cells, seeds: Collection[int]) -> Baseline:
    """A baseline in memory: some seeds, and the project's results of the other methods, for the prior."""
    change = Change(date="", reason="repetitions", version="", commit=None)
    methods = {key.method for key in cells}
    others = [cell for cell in read_baseline(PROJECT).cells if cell.method not in methods]
    made = sorted_cells([*others, *(cell_of(cell) for cell in part(cells, seeds).values())])
    return Baseline(format=FORMAT, changes=[change], environment={}, cells=made)


def verdicts(cells: Cells, base: Collection[int], method: str) -> Iterator[tuple[int, Verdict]]:
    """The verdict on each seed of a method that is not in the baseline; other methods add to the prior."""
    before = baseline_of(cells, base)
    for seed in seeds_of(cells, method):
        if seed not in base:
            yield seed, compare(before, part(cells, [seed], method), times=False)


def seeds_of(cells: Cells, method: str = "") -> list[int]:
    """Seeds that all cells (of a method) have."""
    each = [set(cell.values) for key, cell in cells.items() if method in ("", key.method)]
    return sorted(set.intersection(*each)) if each else []


def read() -> Cells:
    """The cells that the file holds."""
    cells: Cells = {}
    if not VALUES.is_file():
        return cells
    registry = Registry()
    with VALUES.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            rate, views = float(row["rate"]) if row["rate"] else None, int(row["requested_views"])
            texts = {name: row[name] for name in ("dataset", "scene", "method", "variant", "preset", "split")}
            key = Key(**texts, rate=rate, requested_views=views)
            if row["version"] == registry.spec(key.method).version:
                numbers = {
                    name: float(value)
                    for name, value in row.items()
                    if value and (name in _NUMBERS or _VIEW in name)
                }
                cell = cells.setdefault(key, Cell(key, row["version"], row["processor"]))
                seed = int(row["seed"])
                cell.values[seed] = {name: number for name, number in numbers.items() if _VIEW not in name}
                cell.views[seed] = {
                    name.removeprefix(_VIEW): number for name, number in numbers.items() if _VIEW in name
                }
    return cells


def write(cells: Cells) -> None:
    """Write the file, sorted, with nine digits."""
    views = sorted({view for cell in cells.values() for path in cell.views.values() for view in path})
    with VALUES.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        titles = [f"{_VIEW}{view}" for view in views]
        rows.writerow([*Key._fields, "version", "processor", "seed", *_NUMBERS, *titles])
        for key, cell in sorted(cells.items(), key=lambda item: tuple(map(str, item[0]))):
            for seed, values in sorted(cell.values.items()):
                numbers = [values.get(name) for name in _NUMBERS] + [
                    cell.views[seed].get(view) for view in views
                ]
                texts = ["" if number is None else f"{number:.9g}" for number in numbers]
                rows.writerow([*key, cell.version, cell.processor, seed, *texts])


def main() -> None:
    """Run what lacks, then print the counts and what the gate is able to see."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--store", type=Path, default=Path("out/repetitions"), metavar="DIR")
    parser.add_argument(
        "--seeds", type=int, default=45, metavar="N", help="seeds 0 to N - 1 are run; 0: none"
    )
    parser.add_argument("--method", action="append", metavar="NAME", help="run this one; default: all")
    parser.add_argument("--baselines", type=int, default=20, metavar="N", help="number of random baselines")
    options = parser.parse_args()
    every = read()
    for method in (options.method or load_suite("gate").methods) if options.seeds else ():
        lacking = sorted(set(range(options.seeds)) - set(seeds_of(every, method)))
        seeds = " ".join(f"--seed {seed}" for seed in lacking)
        command = f"-m econgs_bench.bench run gate --method {method} {seeds} --no-report --out".split()
        if lacking:
            subprocess.run([sys.executable, *command, str(options.store)], check=True)
    if options.store.is_dir():
        store = Store(options.store)
        for key, cell in cells_of(store, build_tables(store, write=False)).items():
            known = every.setdefault(key, Cell(key, cell.version, cell.processor))
            known.values |= cell.values
            known.views |= cell.views
        write(every)
    for cell in every.values():
        cell.options = {seed: {} for seed in cell.values}
    cells = {key: cell for key, cell in every.items() if set(range(BASE)) < set(cell.values)}
    if not cells:
        sys.exit(f"no method has the seeds 0 to {BASE - 1} and a further one")
    print_alarms(cells, options.baselines)
    for least in sorted({base for base, _ in SEED_COUNTS}):
        print_smallest(
            {key: cell for key, cell in cells.items() if len(seeds_of(cells, key.method)) >= least}, least
        )


def print_alarms(cells: Cells, baselines: int) -> None:
    """By method: repetitions, comparisons, alarms and their bound, then each alarm."""
    print(
        "| method | repetitions | comparisons each | alarms | gains | rate of alarms under (95 %) |", end=""
    )
    print(f" alarms with {baselines} random baselines |\n|---|---|---|---|---|---|---|")
    rng = np.random.default_rng(0)
    findings: list[tuple[int, Finding]] = []
    for method in dict.fromkeys(key.method for key in cells):
        judged = dict(verdicts(cells, range(BASE), method))
        tests = next(iter(judged.values())).tests
        alarms, gains = (sum(bool(v.of(kind)) for v in judged.values()) for kind in ("worse", "better"))
        findings += [(seed, f) for seed, v in judged.items() for f in v.of("worse", "better")]
        bound = f"{1.0 - 0.05 ** (1.0 / len(judged)):.1%}" if not alarms else ""
        own = {key: cell for key, cell in cells.items() if key.method == method}
        others = [
            verdict
            for _ in range(baselines)
            for _, verdict in verdicts(own, rng.choice(seeds_of(own), BASE, replace=False).tolist(), method)
        ]
        again = f"{sum(bool(verdict.of('worse')) for verdict in others)} of {len(others)}"
        print(f"| {method} | {len(judged)} | {tests} | {alarms} | {gains} | {bound} | {again} |", flush=True)
    for seed, finding in findings:
        print(f"seed {seed}: {finding.kind} {finding.cell}: {finding.text}")


def print_smallest(cells: Cells, base: int) -> None:
    """The smallest losses that are found with a baseline of that many seeds, as ranges over all results."""
    if not cells:
        return
    names = ("psnr", "size_bytes", "missing")
    methods = ", ".join(dict.fromkeys(key.method for key in cells))
    print(f"\nsmallest loss that is found, {methods}\n")
    print("| baseline | run | " + " | ".join(QUANTITIES[name].title for name in names) + " |")
    print("|---|---|---|---|---|")
    counts = [runs for count, runs in SEED_COUNTS if count == base]
    losses = power(baseline_of(cells, seeds_of(cells)[:base]), counts, times=False)
    for runs in counts:
        ranges = [_range(losses[name, "a scene"][runs], name) for name in names]
        print(f"| {base} | {runs} | " + " | ".join(ranges) + " |", flush=True)


def _range(losses: list[float], name: str) -> str:
    low, high = (QUANTITIES[name].change(loss).lstrip("+-") for loss in (min(losses), max(losses)))
    return f"{low} to {high}"


if __name__ == "__main__":
    main()
