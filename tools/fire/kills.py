"""Kills -9 while jobs of every kind, merges and reports are at work: ``python -m tools.fire.kills``.

Run, worker or both die at random moments of a job of the wanted kind. In the end the store must be, byte for
byte, that of a run that nobody touched.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from econgs_bench.bench.store.store import Store, read_record
from tests.bench.conftest import PATIENCE, Bench, runs, workers
from tools.fire.attack import REAL, Tally, bench_in, contents, difference, leftovers, work_folder

KINDS = ("dvr", "complexity", "views", "partition", "fit", "encode", "measure")
"""In the order of a run."""
AFTERWARDS = ("merge", "report")
"""Commands that are killed on a finished store."""
VICTIMS = ("run", "worker", "both")


def durations(store: Path) -> dict[str, float]:
    """Kind of a job -> seconds of the longest."""
    longest: dict[str, float] = {}
    for record in Store(store).records():
        longest[record.job.kind] = max(longest.get(record.job.kind, 0.0), record.wall_seconds)
    return longest


def at_work(store: Path, kind: str, since: float) -> bool:
    """Whether a job of a kind began after a time and has no record yet."""
    for progress in store.glob(f"partial/{kind}-*/progress.jsonl"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            if json.loads(progress.read_text().splitlines()[-1])["time"] >= since:
                return True
    return False


def whole(store: Path) -> str:
    """Why a store is not whole between two attempts; "" if it is."""
    for path in [*store.glob("jobs/*/record.json"), *store.glob("partial/*/record.json")]:
        try:
            read_record(path)
        except Exception as error:
            return f"{path}: {error}"
    torn = [path.name for path in store.glob("jobs/*") if not (path / "record.json").is_file()]
    return f"jobs without a record: {torn}" if torn else ""


def kill_in(bench: Bench, suite: Path, kind: str, seconds: float, rng: random.Random) -> str | None:
    """Kill a run or its worker within a job of a kind.

    Returns:
        What is wrong with the store then, "" if nothing; None if no such job was met.
    """
    since = time.time()
    process = bench.start_suite(str(suite), "--retry")
    end = time.monotonic() + PATIENCE
    while not at_work(bench.store, kind, since):
        if process.poll() is not None or time.monotonic() > end:
            process.communicate()
            return None
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, seconds))
    victim = rng.choice(VICTIMS)
    alive = at_work(bench.store, kind, since)
    found = workers(process)
    if victim != "run":
        for worker in found:
            with contextlib.suppress(Exception):
                worker.kill()
    process.send_signal(signal.SIGINT if victim == "worker" else signal.SIGKILL)
    process.communicate(timeout=PATIENCE)
    end = time.monotonic() + PATIENCE
    while any(map(runs, found)):
        if time.monotonic() > end:
            return f"a worker lives on after its run was killed in {kind}"
        time.sleep(0.02)
    return whole(bench.store) if alive else None


def kill_command(bench: Bench, command: list[str], seconds: float, rng: random.Random) -> bool:
    """Kill a command at a random moment; whether it still ran."""
    process = subprocess.Popen(
        command, env=bench.environment, cwd=bench.store.parent, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    time.sleep(rng.uniform(0.0, seconds))
    alive = process.poll() is None
    process.kill()
    process.wait()
    return alive


def kill_afterwards(
    bench: Bench, number: int, rng: random.Random, tally: Tally, commands: tuple[str, ...] = AFTERWARDS
) -> None:
    """Kill merges into a new store, and reports, and compare what they make in the end."""
    merged = bench.store.parent / "merged"
    page = bench.store / "report.html"
    for name in commands:
        arguments = (
            ("merge", bench.store, "--out", merged) if name == "merge" else ("report", "--runs", bench.store)
        )
        start = time.monotonic()
        bench(*arguments)
        seconds = time.monotonic() - start
        before = contents(merged) if name == "merge" else page.stat().st_size
        killed = 0
        while killed < number:
            if name == "merge" and not killed % 5:  # else there is nothing left to merge
                shutil.rmtree(merged, ignore_errors=True)
            if not kill_command(bench, bench.command(*arguments), seconds, rng):
                continue
            killed += 1
            torn = whole(merged) if name == "merge" and merged.exists() else whole(bench.store)
            tally.add(name, torn)
        bench(*arguments)
        if name == "merge":
            tally.add(
                "merged store as undisturbed", difference(before, contents(merged)) or leftovers(merged)
            )
        else:
            wrong = "" if page.stat().st_size == before else "the page has another size"
            tally.add("page as undisturbed", wrong or leftovers(bench.store))


def main(arguments: list[str] | None = None) -> int:
    """Kill as often as asked for, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=200, help="kills in all")
    parser.add_argument("--each", type=int, default=3, help="kills in jobs of one kind, in one store")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, *AFTERWARDS])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rng, tally = random.Random(options.seed), Tally()
    kinds = [kind for kind in KINDS if kind in options.kinds]
    after = tuple(name for name in AFTERWARDS if name in options.kinds)
    share = options.number // (len(kinds) + len(after))
    wanted = dict.fromkeys(kinds, share)
    if kinds:
        wanted[kinds[-1]] += options.number - share * (len(kinds) + len(after))
    with work_folder() as folder:
        suite = folder / "suite.toml"
        suite.write_text(REAL)
        undisturbed = bench_in(folder / "undisturbed")
        undisturbed.run_suite(str(suite))
        expected = contents(undisturbed.store)
        seconds = durations(undisturbed.store)
        life = 0
        while any(wanted.values()):
            life += 1
            bench = bench_in(folder / f"life-{life}")
            for kind in kinds:
                for _ in range(min(options.each, wanted[kind])):
                    torn = kill_in(bench, suite, kind, seconds[kind], rng)
                    if torn is not None:
                        tally.add(kind, torn)
                        wanted[kind] -= 1
            bench.run_suite(str(suite), "--retry")
            wrong = difference(expected, contents(bench.store)) or leftovers(bench.store)
            tally.add("store as undisturbed", wrong)
            shutil.rmtree(bench.store.parent)
        if after:
            kill_afterwards(undisturbed, share, rng, tally, after)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
