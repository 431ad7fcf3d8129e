"""Stores on disks that fail: ``python -m tools.fire.disks`` (on Linux; full and read-only disks need root).

full        a tmpfs of many sizes, so that it fills in every job, in tables and report: the run ends with rows
            or one line; once there is room, it ends as on a whole disk
read-only   every command that reads works, the others end with one line
slow        every call of the file system takes 5 ms more
lock-less   the kernel's locks fail in the store (ENOLCK), as on network file systems: no harm; where they
            fail for the lock of the machine, one line says so
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from econgs_bench.bench.store.store import Store
from tests.bench.conftest import Bench, suite_file, write_dataset
from tools.fire.attack import Tally, bench_in, contents, difference, leftovers, work_folder

PAGE = 4096
ROOM = "64m"
SHIMS = {
    "slow": """
import io, os, time
def late(call):
    def later(*arguments, **named):
        if STORE in str(arguments[0]):
            time.sleep(0.005)
        return call(*arguments, **named)
    return later
for name in ("rename", "replace", "mkdir", "rmdir", "unlink", "utime", "open", "stat", "listdir", "scandir"):
    setattr(os, name, late(getattr(os, name)))
io.open = late(io.open)
import builtins
builtins.open = io.open
""",
    "lock-less": """
import errno, fcntl, os
def lost(call):
    def refused(file, *arguments):
        name = os.readlink(f"/proc/self/fd/{file if isinstance(file, int) else file.fileno()}")
        if STORE in name:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        return call(file, *arguments)
    return refused
for name in ("flock", "lockf", "fcntl"):
    setattr(fcntl, name, lost(getattr(fcntl, name)))
""",
}
"""Disk -> sitecustomize of all processes of a run; STORE is part of the paths that it strikes."""


@contextlib.contextmanager
def mounted(folder: Path, size: str) -> Iterator[Path]:
    """A tmpfs of a size."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def remount(folder: Path, options: str) -> None:
    """Change the options of a mount."""
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True)


def can_mount() -> bool:
    """Whether this process may mount a tmpfs."""
    with work_folder() as folder:
        try:
            with mounted(folder / "try", "64k"):
                return True
        except (OSError, subprocess.CalledProcessError):
            return False


def one_line(done: subprocess.CompletedProcess[str], code: int) -> str:
    """Why a command did not end with a line and a code; "" if it did."""
    lines = done.stderr.strip().splitlines()
    if done.returncode != code or len(lines) != 1 or not lines[0].startswith("bench: "):
        return f"exit code {done.returncode}: {done.stderr[-400:]}"
    return ""


def undisturbed(folder: Path, dataset: Path, suite: str) -> Bench:
    """A run on a whole disk."""
    whole = bench_in(folder / "whole", dataset)
    whole.run_suite(suite)
    return whole


def full(folder: Path, dataset: Path, suite: str, shares: list[float], tally: Tally, whole: Bench) -> None:
    """Run on disks of shares of the room that it takes; then give room and run again."""
    expected = contents(whole.store)
    pages = sum(-(-max(path.stat().st_size, 1) // PAGE) for path in whole.store.rglob("*"))
    with mounted(folder / "disk", f"{PAGE}") as disk:
        for number, share in enumerate(shares):
            remount(disk, f"size={PAGE * (1 + round(share * pages))}")
            if not share:  # not even for the store's marker
                (disk / "ballast").write_bytes(bytes(PAGE))
            bench = bench_in(folder / f"full-{number}", dataset)
            bench.store = disk / "runs"
            done = bench.run_suite(suite, code=None)
            place = reached(bench)
            whole_run = done.returncode == 0 and not difference(expected, contents(bench.store))
            place = "enough room" if whole_run else place
            wrong = "Traceback" in done.stderr or not (whole_run or done.returncode in (1, 2))
            tally.add(
                f"full disk ({place})", f"exit code {done.returncode}: {done.stderr[-600:]}" if wrong else ""
            )
            (disk / "ballast").unlink(missing_ok=True)
            remount(disk, f"size={ROOM}")
            again = bench.run_suite(suite, "--retry", code=None)
            wrong_end = (
                again.stderr[-400:] if again.returncode else difference(expected, contents(bench.store))
            )
            tally.add("as undisturbed with room again", wrong_end or leftovers(bench.store))
            shutil.rmtree(bench.store, ignore_errors=True)


def reached(bench: Bench) -> str:
    """The kind of the first job without success, or what comes after the jobs."""
    try:
        done = {record.job.kind for record in Store(bench.store).records() if record.ok}
    except Exception:
        return "creation"
    return next((kind for kind in ("views", "fit", "encode", "measure") if kind not in done), "tables")


def full_afterwards(folder: Path, dataset: Path, suite: str, tally: Tally) -> None:
    """Reports and merges on a disk without room: one line, and no half page."""
    bench = bench_in(folder / "afterwards", dataset)
    bench.run_suite(suite)
    with mounted(folder / "small", "1m") as disk:
        for name, arguments, made in (
            ("report", ("report", "--runs", disk / "runs"), disk / "runs" / "report.html"),
            ("merge", ("merge", bench.store, "--out", disk / "merged"), disk / "merged" / "report.html"),
            ("bundle", ("bundle", "--runs", bench.store, "--out", disk / "all.zip"), disk / "all.zip"),
        ):
            remount(disk, f"size={ROOM}")
            if name == "report":
                shutil.copytree(bench.store, disk / "runs")
            used = shutil.disk_usage(disk).used
            remount(disk, f"size={used + 2 * PAGE}")
            tally.add(f"full disk ({name})", one_line(bench(*arguments, code=None), 2))
            torn = made.exists()
            remount(disk, f"size={ROOM}")
            done = bench(*arguments, code=None)
            wrong = f"half of {made.name}" if torn else done.stderr[-300:] if done.returncode else ""
            tally.add(f"{name} with room again", wrong)


def read_only(folder: Path, dataset: Path, suite: str, tally: Tally) -> None:
    """Commands on a store that cannot be written."""
    with mounted(folder / "fixed", ROOM) as disk:
        bench = bench_in(folder / "read-only", dataset)
        bench.store = disk / "runs"
        bench.run_suite(suite)
        remount(disk, "ro")
        runs = ("--runs", bench.store)
        for name, arguments, code in (
            ("results", ("results", *runs), 0),
            ("report elsewhere", ("report", *runs, "--out", folder / "page"), 0),
            ("merge elsewhere", ("merge", bench.store, "--out", folder / "merged"), 0),
            ("bundle elsewhere", ("bundle", *runs, "--out", folder / "all.zip"), 0),
            ("report", ("report", *runs), 2),
            ("merge", ("merge", folder / "merged", "--out", disk / "more"), 2),
            ("bundle", ("bundle", *runs, "--out", disk / "all.zip"), 2),
        ):
            done = bench(*arguments, code=None)
            wrong = one_line(done, 2) if code else done.stderr[-400:] if done.returncode else ""
            tally.add("read-only disk", wrong and f"{name}: {wrong}")
        for name, more in (
            ("run", ()),
            ("run of more", ("--seed", 7)),
            ("new store", ("--out", disk / "new")),
        ):
            done = bench.run_suite(suite, *more, code=None)
            wrong = "Traceback" in done.stderr or (done.returncode != 2 and name != "run")
            tally.add(
                "read-only disk",
                f"{name}: exit code {done.returncode}: {done.stderr[-400:]}" if wrong else "",
            )
        remount(disk, "rw")


def give_shim(bench: Bench, name: str, place: Path) -> None:
    """Have all processes of runs import a shim that strikes below a place."""
    shim = bench.store.parent / "shim"
    shim.mkdir()
    (shim / "sitecustomize.py").write_text(f"STORE = {str(place)!r}\n{SHIMS[name]}")
    bench.environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(shim), os.environ.get("PYTHONPATH"))))


def shimmed(
    folder: Path, dataset: Path, suite: str, name: str, tally: Tally, whole: Bench, number: int = 2
) -> None:
    """Runs at once in a store that a shim strikes."""
    bench = bench_in(folder / name, dataset)
    give_shim(bench, name, bench.store)
    runs = [bench.start_suite(suite) for _ in range(number)]
    ends = [(run, run.communicate(timeout=1200)[0]) for run in runs]
    for run, output in ends:
        tally.add(f"{name} disk", output[-400:] if run.returncode else "")
    wrong = difference(contents(whole.store), contents(bench.store)) or leftovers(bench.store)
    tally.add(f"{name} disk: as undisturbed", wrong)


def without_locks(folder: Path, dataset: Path, suite: str, tally: Tally) -> None:
    """The kernel's locks fail for the lock of the machine."""
    bench = bench_in(folder / "no-locks", dataset)
    give_shim(bench, "lock-less", bench.store.parent / "locks")
    bench.patience = 60.0
    try:
        wrong = one_line(bench.run_suite(suite, code=None), 2)
    except subprocess.TimeoutExpired:
        wrong = "it waits for ever"
    tally.add("no lock of the machine", wrong)


def main(arguments: list[str] | None = None) -> int:
    """Attack with every disk, and print what held."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, default=24, help="of full disks")
    parser.add_argument("--only", nargs="+", default=["full", "afterwards", "read-only", "slow", "lock-less"])
    options = parser.parse_args(arguments)
    tally = Tally()
    with work_folder() as folder:
        dataset = write_dataset(folder / "tiny")
        suite = suite_file(folder, f'"{dataset}" = ["a"]', "threads = 1")
        whole = undisturbed(folder, dataset, suite)
        if "full" in options.only:
            shares = [number / options.sizes for number in range(options.sizes)]
            full(folder, dataset, suite, shares, tally, whole)
        if "afterwards" in options.only:
            full_afterwards(folder, dataset, suite, tally)
        if "read-only" in options.only:
            read_only(folder, dataset, suite, tally)
        for name in ("slow", "lock-less"):
            if name in options.only:
                shimmed(folder, dataset, suite, name, tally, whole)
        if "lock-less" in options.only:
            without_locks(folder, dataset, suite, tally)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
