"""Several runs at once on one store: ``python -m tools.fire.together``.

Every job must run once, and store and tables must be those of a single run.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from econgs_bench.bench.store.store import Store
from tests.bench.conftest import PATIENCE, Bench, attempts, suite_file, write_dataset
from tools.fire.attack import REAL, Tally, bench_in, contents, difference, leftovers, work_folder

QUICK = 'methods = ["fake", "fake-joint"]'


def attack(
    folder: Path, dataset: Path, suite: str, numbers: list[int], tally: Tally, alone: Bench | None = None
) -> None:
    """Compare a run alone, made here unless it is given, with numbers of runs at once."""
    if alone is None:
        alone = bench_in(folder / "alone", dataset)
        alone.run_suite(suite)
    expected, jobs = contents(alone.store), len(list(Store(alone.store).records()))
    for number in numbers:
        bench = bench_in(folder / str(number), dataset)
        runs = [bench.start_suite(suite) for _ in range(number)]
        outputs = [run.communicate(timeout=4 * PATIENCE)[0] for run in runs]
        name = f"{number} runs at once"
        for run, output in zip(runs, outputs, strict=True):
            tally.add(name, f"exit code {run.returncode}: {output[-400:]}" if run.returncode else "")
        began = attempts(bench.store)
        tally.add("jobs that ran once", "" if began == jobs else f"{began} attempts at {jobs} jobs")
        wrong = difference(expected, contents(bench.store)) or leftovers(bench.store)
        tally.add("store and tables as of one run", wrong)


def main(arguments: list[str] | None = None) -> int:
    """Run together, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--numbers", type=int, nargs="+", default=[2, 8])
    parser.add_argument("--real", action="store_true", help="a suite of real methods too")
    options = parser.parse_args(arguments)
    tally = Tally()
    with work_folder() as folder:
        dataset = write_dataset(folder / "tiny")
        suite = suite_file(folder, f'"{dataset}" = ["a", "b", "c"]', "threads = 1\nseeds = [0, 1]")
        text = Path(suite).read_text().replace('methods = ["fake"]', QUICK)
        Path(suite).write_text(text)
        attack(folder / "quick", dataset, suite, options.numbers, tally)
        if options.real:
            real = folder / "real.toml"
            real.write_text(REAL)
            attack(folder / "real", dataset, str(real), options.numbers, tally)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
