"""``bench doctor``: what this machine has and lacks, each lack with its remedy."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        verdict: "ok"; "lacks" (something optional is missing); "broken" (runs will fail).
    """

    name: str
    verdict: str
    detail: str
    remedy: str = ""


def doctor(options: Namespace) -> int:
    """Print the findings; exit code 1 if something is broken."""
    broken = False
    for check in CHECKS:
        try:
            finding = check()
        except Exception as error:  # a check that fails is itself a finding
            finding = Finding(
                check.__name__.strip("_"), "broken", f"{type(error).__name__}: {error}", "Install again"
            )
        broken |= finding.verdict == "broken"
        print(f"{finding.verdict:<7} {finding.name:<14} {finding.detail}")
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

    from bench.executor import available_cores

    return Finding("torch", "ok", f"{torch.__version__}, {available_cores()} cores")


def _native() -> Finding:
    from bench.provenance import native_isa
    from bench.timing import reference_seconds

    try:
        import econgs._native  # noqa: F401
    except ImportError as error:
        return Finding(
            "native core",
            "lacks",
            f"not built ({error}); the slow torch backend is used",
            "Install a C++17 compiler and install the project again: pip install .",
        )
    seconds = reference_seconds() or 0.0
    return Finding("native core", "ok", f"{native_isa()}, reference kernel {seconds * 1e3:.1f} ms")


def _ground_truth() -> Finding:
    from datasets.errors import DataError
    from datasets.ground_truth.probe import REMEDY, find_backend

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
    from bench.metrics.lpips import BACKBONES, checkpoints

    path = checkpoints() / BACKBONES["vgg"].file
    if path.is_file():
        return Finding("LPIPS weights", "ok", str(path))
    remedy = f"Put https://download.pytorch.org/models/{path.name} into that folder (or set TORCH_HOME)"
    return Finding(
        "LPIPS weights", "lacks", f"no {path.name} in {path.parent}; lpips_vgg stays empty", remedy
    )


def _data() -> Finding:
    from datasets.catalogue import list_datasets

    count = len(list_datasets())
    folder = os.environ.get("BENCH_DATA")
    if not folder:
        return Finding(
            "data", "lacks", f"BENCH_DATA is not set; {count} datasets known", "Set it to a folder of volumes"
        )
    missing = [part for part in folder.split(os.pathsep) if not Path(part).expanduser().is_dir()]
    if missing:
        return Finding("data", "lacks", f"BENCH_DATA names no folder: {', '.join(missing)}", "Correct it")
    return Finding("data", "ok", f"{folder}; {count} datasets known")


def _cache() -> Finding:
    from datasets.view_cache import ViewCache

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
    _python, _torch, _native, _ground_truth, _gpu, _lpips, _data, _cache, _disk,
)  # fmt: skip
