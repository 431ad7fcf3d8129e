"""Where a job runs: machine, software, commit, and the hash of a method's source."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.store.records import Provenance
from econgs_bench.methods.interface import MethodSpec

PACKAGES = (
    "econgs-bench", "numpy", "scipy", "torch", "gsplat", "mitsuba", "drjit", "scikit-image", "lpips",
    "flip-evaluator", "safetensors",
)  # fmt: skip


def provenance(threads: int, spec: MethodSpec | None, device: str) -> Provenance:
    """The facts about this process; needs no heavy import of its own."""
    return Provenance(
        machine=machine_name(),
        cpu=cpu(),
        cores=os.cpu_count() or 1,
        usable=available_cores(),
        threads=threads,
        memory_bytes=psutil.virtual_memory().total,
        gpu=_gpu(device),
        system=platform.platform(),
        python=platform.python_version(),
        versions=_versions(),
        isa=native_isa(),
        commit=commit_here(),
        source=source_hash(spec) if spec else None,
    )


def machine_name() -> str:
    """The machine's name in records."""
    return platform.node() or "unknown"


def source_hash(spec: MethodSpec) -> str | None:
    """Hash of the Python source of the modules that ``spec.source`` names, found without running them, and of
    ``spec.files``.

    Returns:
        None where a source is gone.
    """
    digest = hashlib.sha256()
    try:
        for module in sorted(spec.source):
            digest.update(_module_hash(module).encode())
        for file in spec.files:
            digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    except OSError:
        return None
    return digest.hexdigest()[:16]


@cache
def _module_hash(module: str) -> str:
    digest = hashlib.sha256(module.encode())
    for file in _module_files(module):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _module_files(module: str) -> list[Path]:
    """Python files of a module or package, sorted; none if there is no such module."""
    try:
        spec = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        return []
    if spec is None:
        return []
    roots = [Path(p) for p in spec.submodule_search_locations or ()]
    files = [f for root in roots for f in root.rglob("*.py")]
    return sorted(files or ([Path(spec.origin)] if spec.origin else []))


@cache
def imports_torch(*modules: str) -> bool:
    """Whether the source of a module names torch in an import statement."""
    statement = re.compile(rb"^\s*(import|from) torch\b", re.MULTILINE)
    return any(statement.search(file.read_bytes()) for m in modules for file in _module_files(m))


def native_isa() -> str | None:
    """Instruction set of the native core, if this process has loaded it."""
    native = sys.modules.get("econgs_bench.econgs._native")
    return str(native.isa()) if native is not None else None


def cpu() -> str:
    """Model of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _gpu(device: str) -> str | None:
    torch = sys.modules.get("torch")
    if torch is None or not device.startswith("cuda") or not torch.cuda.is_available():
        return None
    return str(torch.cuda.get_device_name(device))


def _versions() -> dict[str, str]:
    versions = {}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def commit_here() -> str | None:
    """Commit of the clone that the package runs from or was built in ("+" if it had changes), if any."""
    here = Path(__file__).resolve()
    root, built = here.parents[2], here.parents[1] / "commit.txt"  # see CMakeLists.txt
    if not (root / ".git").exists():
        return built.read_text(encoding="ascii").strip() if built.exists() else None
    try:
        head = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            capture_output=True, encoding="utf-8", timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return head.stdout.strip() or None
