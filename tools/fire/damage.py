"""Random damage to what a run keeps on disk: ``python -m tools.fire.damage``.

Cache entries, stored truth, checkpoints, records, bundles and the store's own files are damaged at random.
Each must be refused, made again, or give exactly what it gave before: never other numbers.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from econgs_bench.bench.jobs.checkpoints import read_checkpoint
from econgs_bench.bench.jobs.truth import Truth
from econgs_bench.bench.results.bundle import unpacked, write_bundle
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.view_cache import ViewCache
from tests.bench.conftest import Bench, suite_file, wait_for, write_dataset
from tests.datasets.damage import KINDS, damage
from tools.fire.attack import REAL, Tally, bench_in, contents, difference, leftovers, work_folder

REFUSED = "refused"


def same(one: Any, other: Any) -> bool:
    """Whether two values, arrays and tensors among them, are equal in every bit that counts."""
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and one.keys() == other.keys()
            and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    return bool(np.array_equal(one, other)) if isinstance(one, np.ndarray) else one == other


def attack(
    name: str, file: Path, read: Callable[[], Any], number: int, rng: np.random.Generator, tally: Tally
) -> None:
    """Damage a file as often as asked for; what is read is refused, or as before."""
    whole, before = file.read_bytes(), read()
    for _ in range(number):
        kind, at = KINDS[rng.integers(len(KINDS))], float(rng.uniform(0, 1 if rng.integers(2) else 0.3))
        value = int(rng.integers(256))
        damage(file, kind, min(at, 0.9999), value)
        what = f"{file.name} {kind} at {at:.4f} with {value}"
        try:
            found = read()
            fits = found is REFUSED or same(found, before)
            tally.add(name, "" if fits else f"{what}: other values")
        except DataError as error:
            tally.add(name, "" if error.remedy else f"{what}: {error}")
        except Exception as error:
            tally.add(name, f"{what}: {type(error).__name__}: {error}")
        file.unlink(missing_ok=True)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(whole)


def of_cache(cache: ViewCache, entry: Path) -> Any:
    """Images and record of an entry, which is kept aside: the cache removes damaged ones."""
    shutil.copytree(entry, entry.with_name("aside"))
    found = cache.get(entry.name)
    shutil.rmtree(entry, ignore_errors=True)
    entry.with_name("aside").rename(entry)
    return REFUSED if found is None else (found.images, found.record)


def of_truth(folder: Path) -> Any:
    """All that later jobs read of a views job."""
    truth = Truth(folder)
    views = truth.views("test")
    cloud = truth.cloud(50, 1)
    return (
        views.images,
        repr(views.cameras),
        views.background,
        cloud.points,
        cloud.colors,
        repr(truth.scene()),
    )


def of_checkpoint(folder: Path) -> Any:
    checkpoint, harness = read_checkpoint(folder) or (None, None)
    return REFUSED if checkpoint is None else (vars(checkpoint), harness)


def of_record(root: Path, job: str) -> Any:
    record = Store(root).record(job)
    return REFUSED if record is None else record.model_dump()


def of_bundle(path: Path) -> Any:
    """Tables of a bundle that holds."""
    with unpacked(path) as store:
        return {name: table.to_csv() for name, table in stored_tables(store.records()).items()}


def of_store(root: Path) -> Any:
    return [record.job.id for record in Store(root).records()]


def files(store: Path, pattern: str) -> Iterator[Path]:
    """The files of finished jobs that fit a pattern, at least one."""
    found = sorted(store.glob(f"jobs/{pattern}"))
    assert found, pattern
    yield from found


def attack_files(bench: Bench, number: int, seed: int, tally: Tally) -> None:
    """Damage every kind of file of a finished store of real jobs."""
    rng, store = np.random.default_rng(seed), bench.store
    cache = ViewCache(bench.store.parent / "cache" / "views")
    entries = sorted(entry for entry in cache.folder.iterdir() if not entry.name.startswith("."))
    for file in ("entry.json", "images.zst"):
        attack("cache entries", entries[0] / file, lambda: of_cache(cache, entries[0]), number, rng, tally)
    views = next(files(store, "views-*/cloud.npz")).parent
    for file in ("views.json", "test.zst", "cloud.npz"):
        attack("stored truth", views / file, lambda: of_truth(views), number, rng, tally)
    (checkpoint,) = files(store, "fit-*/checkpoint")
    for file in ("checkpoint.json", "arrays.safetensors"):
        path = next(checkpoint.glob(f"*/{file}"))
        attack("checkpoints", path, lambda: of_checkpoint(checkpoint), number, rng, tally)
    kinds = ("views", "dvr", "complexity", "partition", "fit", "encode", "measure")
    for kind in kinds:
        path = next(files(store, f"{kind}-*/record.json"))
        job = path.parent.name
        share = max(1, 2 * number // len(kinds))
        attack("records", path, lambda job=job: of_record(store, job), share, rng, tally)
    path = store.parent / "all.zip"
    write_bundle(Store(store), path, models=True)
    attack("bundles", path, lambda: of_bundle(path), max(1, number // 2), rng, tally)
    attack("store.json", store / "store.json", lambda: of_store(store), number, rng, tally)


def attack_runs(folder: Path, dataset: Path, number: int, seed: int, tally: Tally) -> None:
    """Stop runs within a fit, damage what lies there, and go on: in the end all is as undisturbed."""
    rng = np.random.default_rng(seed)
    suite = suite_file(folder, f'"{dataset}" = ["a"]', "threads = 1")
    undisturbed = bench_in(folder / "undisturbed", dataset)
    undisturbed.run_suite(suite, "--set", "fake.iterations=40")
    expected = contents(undisturbed.store)
    for attempt in range(number):
        bench = bench_in(folder / f"run-{attempt}", dataset)
        slow = ("--set", "fake.behaviour=hold", "--set", f"fake.file={bench.store.parent / 'go on'}")
        process = bench.start_suite(suite, "--set", "fake.iterations=40", *slow)
        wait_for(lambda store=bench.store: any('"held"' in file.read_text() for file in progress_of(store)))
        process.terminate()
        process.communicate()
        partial = next(bench.store.glob("partial/fit-*"))
        (bench.store / "locks" / partial.name).mkdir(exist_ok=True)
        stray = bench.store / "locks" / partial.name / "stray"
        stray.write_text("no token")
        os.utime(stray, (0.0, 0.0))
        for file in sorted(path for path in partial.rglob("*") if path.is_file() and path.stat().st_size):
            damage(file, KINDS[rng.integers(len(KINDS))], float(rng.uniform(0, 0.9)), int(rng.integers(256)))
        (bench.store.parent / "go on").touch()
        done = bench.run_suite(suite, "--set", "fake.iterations=40", *slow, "--retry", code=None)
        found = {n: h for n, h in contents(bench.store).items() if "/model/" in n}
        models = {n.split("/")[-1]: h for n, h in found.items()}
        due = {n.split("/")[-1]: h for n, h in expected.items() if "/model/" in n}
        wrong = difference(due, models) if done.returncode == 0 else done.stderr[-400:]
        tally.add("runs with a damaged partial folder", wrong or leftovers(bench.store))
        shutil.rmtree(bench.store.parent)


def progress_of(store: Path) -> list[Path]:
    return list(store.glob("partial/fit-*/progress.jsonl"))


def main(arguments: list[str] | None = None) -> int:
    """Damage, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=500, help="of each file")
    parser.add_argument("--runs", type=int, default=10, help="runs with a damaged partial folder")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    tally = Tally()
    with work_folder() as folder:
        bench = bench_in(folder / "real")
        suite = folder / "suite.toml"
        suite.write_text(REAL)
        bench.run_suite(str(suite))
        attack_files(bench, options.number, options.seed, tally)
        attack_runs(folder, write_dataset(folder / "tiny"), options.runs, options.seed, tally)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
