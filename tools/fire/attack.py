"""What the attacks share: counts of n, stores of tiny suites, and what of a store no attack may change."""

from __future__ import annotations

import contextlib
import hashlib
import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from tests.bench.conftest import Bench, plain_tables

DEPENDS_ON_THE_MACHINE = {"record.json", "job.json", "log.txt", "progress.jsonl", "checkpoint.json"}
"""Files of a job with times in them; tables without those columns stand for the records."""
REAL = """title = "joint fits"
methods = ["econgs"]
preset = "quick"
threads = 1
dvr = true
parsimony = true
variants = [{ econgs = { iterations = 20, threshold = 10 } }]
[presets.quick]
train_views = 6
test_views = 3
width = 24
height = 24
prerendered_limit = 24
cloud_points = 200
[datasets]
"shells@16" = ["outer", "middle"]
"""
"""Eleven jobs of every kind, 15 s in all: two scenes that ECoNGS fits together."""


class Tally:
    """Counts attacks by name, those that the harness withstood and all; prints a line per deviation."""

    def __init__(self) -> None:
        self.counts: dict[str, list[int]] = {}
        self.failed = False

    def add(self, name: str, deviation: str = "") -> None:
        """Count an attack; a deviation is what must not be."""
        count = self.counts.setdefault(name, [0, 0])
        count[0] += not deviation
        count[1] += 1
        if deviation:
            self.failed = True
            print(f"    {name}: {deviation}", flush=True)

    def finish(self) -> int:
        """Print the counts; the exit code."""
        for name, (held, number) in self.counts.items():
            print(f"{name}: {held} of {number}")
        held, number = (sum(count[place] for count in self.counts.values()) for place in (0, 1))
        print(f"all: {held} of {number}", flush=True)
        return int(self.failed)


@contextlib.contextmanager
def work_folder() -> Iterator[Path]:
    """A folder for the attacks of one script; TMPDIR moves it."""
    folder = Path(tempfile.mkdtemp(prefix="fire-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def bench_in(folder: Path, dataset: Path | None = None) -> Bench:
    """``bench`` with a store, cache and locks of its own; neighbours name one folder of weights."""
    folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(folder, dataset or folder)
    bench.environment |= {"OMP_NUM_THREADS": "1", "TORCH_HOME": str(folder.parent / "torch")}
    return bench


def contents(store: Path) -> dict[str, str]:
    """Files of finished jobs and tables -> their hash, without what depends on the machine."""
    found = {}
    for path in sorted(store.glob("jobs/**/*")):
        if path.is_file() and path.name not in DEPENDS_ON_THE_MACHINE:
            found[path.relative_to(store).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    for name, text in plain_tables(store).items():
        table = pd.read_csv(io.StringIO(text), dtype=str)
        for column in table:
            digest = hashlib.sha256("\0".join(map(str, table[column])).encode())
            found[f"tables/{name}.{column}"] = digest.hexdigest()
    return found


def difference(one: dict[str, str], other: dict[str, str]) -> str:
    """Names of what differs between the contents of two stores; "" if nothing does."""
    names = sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
    return f"{len(names)} differ: {', '.join(names[:4])}" if names else ""


def leftovers(store: Path) -> str:
    """What a finished run has left in a store that should be gone; "" if nothing."""
    left = [*(store / "partial").iterdir(), *(store / "locks").glob("*-*"), *store.glob("**/.*.????????*")]
    return f"left behind: {', '.join(path.name for path in left[:4])}" if left else ""
