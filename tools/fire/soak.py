"""Small jobs in one `bench` process for as long as asked for: ``python -m tools.fire.soak --hours 24``.

After every round it counts the resident memory, open files, threads and children of the process, and what
lies in the store and in the temporary folder. With a new store nothing may be more than with the first.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

import econgs_bench as bench
from econgs_bench.bench.store.store import Store
from tests.bench.conftest import PLUGINS, write_dataset
from tools.fire.attack import REAL, Tally, work_folder

EVERY = 10
"""Rounds from one with a real method to the next, and half those until the store is a new one."""
GROWTH_MIB = 10.0
"""Memory that the process may take more with the last store than with the first."""


@dataclass
class Sample:
    """Counts after a round."""

    hours: float
    jobs: int
    resident_mib: float
    handles: int
    threads: int
    children: int
    files: int
    unfinished: int
    temporary: int


def sample(start: float, jobs: int, store: Path, temporary: Path) -> Sample:
    """Count."""
    process = psutil.Process()
    return Sample(
        hours=round((time.monotonic() - start) / 3600, 4),
        jobs=jobs,
        resident_mib=round(process.memory_info().rss / 2**20, 1),
        handles=process.num_fds(),
        threads=process.num_threads(),
        children=len(process.children(recursive=True)),
        files=sum(len(names) for _, _, names in os.walk(store)),
        unfinished=sum(1 for name in ("partial", "locks") for _ in (store / name).iterdir()),
        temporary=sum(1 for _ in temporary.iterdir()),
    )


def soak(folder: Path, seconds: float, out: Path | None = None) -> tuple[list[Sample], int]:
    """Run rounds until the time is over; their samples, and how many jobs failed that should not."""
    os.environ |= {
        "BENCH_CACHE": str(folder / "cache"), "BENCH_LOCKS": str(folder / "locks"),
        "XDG_STATE_HOME": str(folder / "state"), "TORCH_HOME": str(folder / "torch"),
    }  # fmt: skip
    temporary = folder / "temporary"
    temporary.mkdir()
    os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
    dataset, suite = write_dataset(folder / "tiny"), folder / "suite.toml"
    suite.write_text(REAL)
    samples: list[Sample] = []
    start, jobs, failed, number = time.monotonic(), 0, 0, 0
    seen: set[str] = set()
    while not samples or time.monotonic() - start < seconds:
        store = folder / f"runs-{number // (2 * EVERY)}"
        if number % (2 * EVERY) == 0:
            shutil.rmtree(folder / f"runs-{number // (2 * EVERY) - 1}", ignore_errors=True)
            seen = set()
        before = len(seen)
        common = {"out": store, "seeds": [number], "quiet": True, "plugins": [PLUGINS]}
        methods = ["fake", "fake-joint", "fake-torch"]
        bench.run(
            "quick", datasets=[dataset], scenes=["a", "b"], methods=methods,
            options={"fake-torch": {"behaviour": "raise" if number % 2 else "child"}}, **common,
        )  # fmt: skip
        if number % EVERY == EVERY - 1:
            bench.run(suite, **common)
        kept = [*Store(store).records()]
        failed += sum(
            not one.ok and one.job.axes()["method"] != "fake-torch" for one in kept if one.job.id not in seen
        )
        seen = {one.job.id for one in kept}
        jobs += len(kept) - before
        samples.append(sample(start, jobs, store, temporary))
        number += 1
        if out is not None:
            new = not out.exists()
            with out.open("a", newline="") as file:
                writer = csv.DictWriter(file, list(asdict(samples[-1])))
                if new:
                    writer.writeheader()
                writer.writerow(asdict(samples[-1]))
    return samples, failed


def judge(samples: list[Sample], failed: int, tally: Tally) -> None:
    """Compare the rounds of the last store with those of the first: within one, memory grows with it."""
    first, last = samples[: 2 * EVERY], samples[-2 * EVERY :]
    for name, slack in (("resident_mib", GROWTH_MIB), ("handles", 0), ("threads", 0), ("children", 0)):
        before, after = (max(getattr(one, name) for one in part) for part in (first, last))
        print(f"{name}: at most {before:g} with the first store, {after:g} with the last")
        tally.add(name, f"grew from {before} to {after}" if after > before + slack else "")
    for name in ("unfinished", "temporary"):
        most = max(getattr(one, name) for one in samples)
        tally.add(name, f"{most} left behind" if most else "")
    tally.add("jobs", f"{failed} failed that should not" if failed else "")
    print(f"{samples[-1].hours:.2f} h, {len(samples)} rounds, {samples[-1].jobs} jobs")


def main(arguments: list[str] | None = None) -> int:
    """Soak, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--out", type=Path, help="CSV file for the samples")
    options = parser.parse_args(arguments)
    tally = Tally()
    with work_folder() as folder:
        samples, failed = soak(folder, 3600 * options.hours, options.out)
    judge(samples, failed, tally)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
