"""The harness itself: wall and processor time of ``bench run quick`` by part, of ``bench list``, of a report;
first paint of the page.

python -m tools.benchmarks.bench_house [--python PYTHON] [--store STORE]

--python is the interpreter of the installation to measure (default: this one), --store what ``bench report``
reads (default: the store of the run). The run starts without cached views. Where others use the machine,
processor time (user + system of all processes) says more than wall time.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import psutil


class Processes:
    """Wall and processor seconds of a process and of the jobs that it runs, by sampling /proc."""

    def __init__(self, pid: int) -> None:
        self._main = psutil.Process(pid)
        self.jobs: dict[str, dict[int, tuple[float, float]]] = defaultdict(dict)
        self.others: dict[int, float] = {}
        self.main = self.main_until_last_job = 0.0

    def sample(self) -> None:
        with contextlib.suppress(psutil.Error):
            self.main = _seconds(self._main)
            for child in self._main.children(recursive=True):
                with contextlib.suppress(psutil.Error, OSError):
                    self._add(child)

    def _add(self, child: psutil.Process) -> None:
        seconds = _seconds(child)
        log = Path(os.readlink(f"/proc/{child.pid}/fd/1"))
        if log.parent.parent.name in ("partial", "jobs"):
            self.jobs[log.parent.name][child.pid] = (time.time() - child.create_time(), seconds)
            self.main_until_last_job = self.main
        else:
            self.others[child.pid] = seconds


def _seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def run(command: list[str], environment: dict[str, str], folder: Path) -> tuple[float, float, Processes]:
    """Wall and processor seconds of a command with all its children, and its samples."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with (folder / "output.txt").open("w") as output:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=output, stderr=output)
        samples = Processes(process.pid)
        while process.poll() is None:
            samples.sample()
            time.sleep(0.02)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        sys.exit((folder / "output.txt").read_text())
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cpu, samples


def print_run(store: Path, wall: float, cpu: float, samples: Processes) -> None:
    """One line per kind of job, then the parent's share."""
    import json

    kinds: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])
    for job, attempts in samples.jobs.items():
        record = json.loads((store / "jobs" / job / "record.json").read_text())
        job_wall, job_cpu = (sum(column) for column in zip(*attempts.values(), strict=True))
        name = record["job"]["kind"]
        if name == "fit":
            trained = record["fit"]["seconds"], record["fit"]["cpu_seconds"] or 0.0
            _add(kinds["fit: training"], *trained)
            name, job_wall, job_cpu = "fit: all else", job_wall - trained[0], job_cpu - trained[1]
        _add(kinds[name], job_wall, job_cpu)
    for name, (count, job_wall, job_cpu) in kinds.items():
        print(f"  {name:<24} {count:2.0f} x {job_wall:7.2f} s wall {job_cpu:7.2f} s CPU {job_cpu / cpu:6.1%}")
    accounted = sum(job_cpu for _, _, job_cpu in kinds.values())
    others = sum(samples.others.values())
    rows = {
        "parent, until last job": samples.main_until_last_job,
        "parent, tables and report": samples.main - samples.main_until_last_job,
        "server, probes, git": others,
        "short processes": cpu - accounted - samples.main - others,
    }
    for name, seconds in rows.items():
        print(f"  {name:<24} {'':19} {seconds:7.2f} s CPU {seconds / cpu:6.1%}")
    training = kinds["fit: training"]
    print(
        f"  training's share: {training[1] / wall:.1%} of wall, {training[2] / cpu:.1%} of CPU time",
        flush=True,
    )


def _add(row: list[float], wall: float, cpu: float) -> None:
    row[0] += 1
    row[1] += wall
    row[2] += cpu


def print_page(page: Path, folder: Path) -> None:
    """Size of the page, its height before anything is unfolded, and its first paint, best of five."""
    from tests.reports.page.browser import Browser, executable

    if executable() is None:
        return
    paint = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
    with Browser(folder / "profile") as browser:
        browser.emulate(1300, 900)
        times = []
        for _ in range(5):
            browser.open(page)
            times.append(browser.until(paint))
        height = browser.run("document.documentElement.scrollHeight")
    size = page.stat().st_size / 1e6
    print(f"page {'':25} {min(times):5.0f} ms to first paint, {size:.1f} MB, {height} px")


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--store", type=Path)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bench-house-"))
    environment = {
        **os.environ,
        "PYTHONSAFEPATH": "1",
        "BENCH_CACHE": str(folder / "cache"),
        "BENCH_LOCKS": str(folder / "locks"),
    }
    bench = [options.python, "-m", "econgs_bench.bench"]
    try:
        for what in ("methods", "datasets", "suites", "metrics"):
            times = [run([*bench, "list", what], environment, folder)[:2] for _ in range(5)]
            wall, cpu = (min(column) for column in zip(*times, strict=True))
            print(f"bench list {what:<19} {wall:7.2f} s wall {cpu:7.2f} s CPU (best of 5)", flush=True)
        store = folder / "runs"
        wall, cpu, samples = run([*bench, "run", "quick", "--out", str(store)], environment, folder)
        print(f"bench run quick {'':14} {wall:7.2f} s wall {cpu:7.2f} s CPU")
        print_run(store, wall, cpu, samples)
        if options.store is not None:
            shutil.rmtree(store)
            shutil.copytree(options.store, store)
        wall, cpu, _ = run([*bench, "report", "--runs", str(store)], environment, folder)
        print(f"bench report {'':17} {wall:7.2f} s wall {cpu:7.2f} s CPU", flush=True)
        print_page(store / "report.html", folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
