"""The cluster executor beside the local one: what Dask adds to a job, and what a second worker gains.

python -m tools.benchmarks.bench_executor [--jobs N] [--seeds N] [--iterations N] [--rounds N]

Overhead: jobs of a method that takes no time, one after the other, by both executors in turn. Gain: fits of
3DGS on one thread, by one worker and by two on disjoint cores, in turn. Times are from the begin of the first
job after the views to the end of the last one; the best of the rounds counts. The cores must be free: the
load is printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from datetime import datetime
from pathlib import Path

from econgs_bench.bench.store.store import Store

ROOT = Path(__file__).resolve().parents[2]
SUITE = """title = "t"
methods = ["{method}"]
preset = "tiny"
threads = 1
seeds = {seeds}
[datasets]
"vortices" = ["cores"]
[presets.tiny]
like = "quick"
train_views = 12
test_views = 2
width = 128
height = 128
prerendered_limit = 128
"""


def seconds(folder: Path, suite: Path, *more: str) -> tuple[float, int]:
    """Time of a sweep without its views, and its number of jobs."""
    out = Path(tempfile.mkdtemp(dir=folder))
    bench = [sys.executable, "-m", "econgs_bench.bench"]
    command = [*bench, "run", str(suite), "--out", str(out), "--no-report"]
    plugins = ("--plugins", str(ROOT / "tests" / "bench" / "plugins"))
    environment = os.environ | {"BENCH_CACHE": str(folder / "cache")}
    done = subprocess.run(
        [*command, *plugins, *more], env=environment, check=False, capture_output=True, encoding="utf-8"
    )
    if done.returncode:
        sys.exit(done.stderr)
    records = [record for record in Store(out).records() if record.job.kind != "views"]
    assert all(record.ok for record in records)
    first = min(datetime.fromisoformat(record.started) for record in records)
    last = max(datetime.fromisoformat(record.finished) for record in records)
    return (last - first).total_seconds(), len(records)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=30, help="of the sweep for the overhead (default: 30)")
    parser.add_argument("--seeds", type=int, default=8, help="of the sweep for the gain (default: 8)")
    parser.add_argument("--iterations", type=int, default=400, help="of its fits (default: 400)")
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    dask = ("--executor", "dask", "--workers")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tiny, long = folder / "tiny.toml", folder / "long.toml"
        tiny.write_text(SUITE.format(method="fake", seeds=list(range(options.jobs // 3))))
        long.write_text(SUITE.format(method="3dgs", seeds=list(range(options.seeds))))
        iterations = ("--set", f"3dgs.iterations={options.iterations}")
        sweeps = {
            "local": (tiny, ()),
            "dask": (tiny, (*dask, "1")),
            "one": (long, (*iterations, *dask, "1")),
            "two": (long, (*iterations, *dask, "2")),
        }
        best: dict[str, tuple[float, int]] = {}
        for _ in range(options.rounds):
            for sweep, (suite, more) in sweeps.items():
                time = seconds(folder, suite, *more)
                best[sweep] = min(best.get(sweep, time), time)
                print(
                    f"{sweep:<6} {time[0]:7.1f} s, {time[1]} jobs, load {os.getloadavg()[0]:.1f}", flush=True
                )
    (local, jobs), (other, _) = best["local"], best["dask"]
    print(f"overhead of a job: {(other - local) / jobs:.3f} s")
    print(f"two workers: {best['one'][0] / best['two'][0]:.2f} times as fast as one")


if __name__ == "__main__":
    main()
