"""``bench doctor``: what this machine has and lacks, each lack with its remedy."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from econgs_bench.bench.commands.arguments import add_plugins


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        verdict: "ok"; "lacks" (something optional is missing); "busy" (times would be disturbed); "broken"
            (runs will fail).
    """

    name: str
    verdict: str
    detail: str
    remedy: str = ""


def doctor_arguments(parser: ArgumentParser) -> None:
    """What ``bench doctor`` takes."""
    add_plugins(parser)


def doctor(options: Namespace) -> int:
    """Print the findings as they come; exit code 1 if something is broken."""
    broken = False
    for check in CHECKS:
        try:
            finding = check()
        except Exception as error:  # a check that fails is itself a finding
            finding = Finding(
                check.__name__.strip("_"), "broken", f"{type(error).__name__}: {error}", "Install again"
            )
        broken |= finding.verdict == "broken"
        print(f"{finding.verdict:<7} {finding.name:<14} {finding.detail}", flush=True)
        if finding.remedy:
            print(f"{'':<23}→ {finding.remedy}")
    return int(broken)


def _python() -> Finding:
    version = platform.python_version()
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return Finding(
        "Python",
        "ok" if good else "lacks",
        f"{version}, {sys.prefix}",
        "" if good else "Use Python 3.11 to 3.13",
    )


def _torch() -> Finding:
    import torch

    return Finding("torch", "ok", str(torch.__version__))


def _native() -> Finding:
    from econgs_bench.bench.machine.provenance import native_isa

    try:
        import econgs_bench.econgs._native  # noqa: F401
    except ImportError as error:
        return Finding(
            "native core",
            "lacks",
            f"not built ({error}); the slow torch backend is used",
            "Install a C++17 compiler and install the project again: pip install .",
        )
    return Finding("native core", "ok", str(native_isa()))


def _cores() -> Finding:
    from econgs_bench.bench.machine.control_groups import cpu_quota
    from econgs_bench.bench.machine.load import clock_cap
    from econgs_bench.bench.machine.timing import available_cores

    cores, quota, cap = available_cores(), cpu_quota(), clock_cap()
    detail = f"{cores} of {os.cpu_count()} usable"
    if cap is not None:
        detail += f", clock capped at {cap[0] / 1e9:.1f} of {cap[1] / 1e9:.1f} GHz"
    if quota is None or quota >= cores:
        return Finding("cores", "ok", f"{detail}, no quota below that")
    return Finding(
        "cores",
        "lacks",
        f"{detail}, but the control group grants {quota:.2g} (cpu.max): all threads pause when it is spent",
        "Raise the quota, or bind the run to as many cores (taskset): speeds are uneven otherwise",
    )


def _machine() -> Finding:
    from econgs_bench.bench.machine.load import BUSY, measure_load, user_text

    load = measure_load()
    parts = [f"others use {load.foreign:.1f} of {load.cores} cores"]
    if load.users:
        parts[0] += f" ({user_text(load.users)})"
    if load.average is not None:
        parts.append(f"load {load.average:.1f}")
    if load.laps:
        low, middle, high = (1e3 * seconds for seconds in load.quantiles)
        laps = f"{middle:.0f} ms ({low:.0f} to {high:.0f} in {len(load.laps)} laps)"
        parts.insert(0, f"reference kernel {laps}")
    detail = ", ".join(parts)
    if load.locked:
        remedy = "A timed job of a run is under way: the next one waits for it. Ask again afterwards"
        return Finding("machine", "busy", detail, remedy)
    if not load.busy:
        return Finding("machine", "ok", f"quiet: {detail}; training times and FPS measured now count")
    return Finding(
        "machine",
        "busy",
        f"busy, up to {load.slowdown:.1f} times slower than quiet (limit {BUSY}): {detail}",
        "Training times and FPS measured now would be marked as disturbed and take no part in conclusions on "
        "speed; sizes and quality do. End what else runs; `bench run --retry busy` measures them again",
    )


def _ground_truth() -> Finding:
    from econgs_bench.datasets.errors import DataError
    from econgs_bench.datasets.ground_truth.probe import REMEDY, find_backend

    try:
        backend = find_backend()
    except DataError as error:
        return Finding("Mitsuba", "lacks", f"{error.what}: {error.reason}", error.remedy)
    if backend.name == "none":
        return Finding(
            "Mitsuba", "lacks", f"no working backend: {backend.reason}; slow reference marcher", REMEDY
        )
    return Finding("Mitsuba", "ok", f"{backend.name} {backend.library}".strip())


def _gpu() -> Finding:
    import torch

    if not torch.cuda.is_available():
        return Finding("GPU", "lacks", "torch sees no CUDA device; everything runs on the CPU")
    name = torch.cuda.get_device_name(0)
    try:
        import gsplat
    except ImportError as error:
        return Finding("GPU", "lacks", f"{name}, but no gsplat ({error})", "pip install 'econgs-bench[cuda]'")
    return Finding("GPU", "ok", f"{name}, gsplat {gsplat.__version__}")


def _lpips() -> Finding:
    from econgs_bench.bench.metrics.lpips import BACKBONES, checkpoints

    folder = checkpoints()
    missing = [backbone.file for backbone in BACKBONES.values() if not (folder / backbone.file).is_file()]
    if not missing:
        return Finding("LPIPS weights", "ok", str(folder))
    detail = f"no {' or '.join(missing)} in {folder}; those metrics stay empty"
    return Finding("LPIPS weights", "lacks", detail, "Run `bench fetch lpips` (TORCH_HOME moves the folder)")


def _data() -> Finding:
    from econgs_bench.datasets.catalogue import data_folders, list_datasets

    named = filter(None, os.environ.get("BENCH_DATA", "").split(os.pathsep))
    if missing := [part for part in named if not Path(part).expanduser().is_dir()]:
        return Finding("data", "lacks", f"BENCH_DATA names no folder: {', '.join(missing)}", "Correct it")
    sets = [info for info in list_datasets() if info.kind in ("volume", "views")]
    here = sum(info.available for info in sets)
    detail = f"{here} of {len(sets)} sets with files are in {', '.join(map(str, data_folders()))}"
    remedy = "" if here else "`bench fetch` gets sets of `bench list datasets`; or set BENCH_DATA"
    return Finding("data", "ok" if here else "lacks", detail, remedy)


def _cache() -> Finding:
    from econgs_bench.datasets.view_cache import ViewCache

    views = ViewCache()
    views.folder.mkdir(parents=True, exist_ok=True)
    if not os.access(views.folder, os.W_OK):
        return Finding(
            "cache", "broken", f"{views.folder} cannot be written", "Set BENCH_CACHE to another folder"
        )
    return Finding("cache", "ok", f"{views.folder}, {views.size() / 2**20:.0f} MiB")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    low = free < 2 * 2**30
    detail = f"{free / 2**30:.1f} GiB free in {Path.cwd()}"
    return Finding(
        "disk", "lacks" if low else "ok", detail, "Free some, or use --out elsewhere" if low else ""
    )


CHECKS: tuple[Callable[[], Finding], ...] = (
    _python, _torch, _native, _ground_truth, _gpu, _lpips, _data, _cache, _disk, _cores, _machine,
)  # fmt: skip
