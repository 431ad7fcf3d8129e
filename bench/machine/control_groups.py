"""Limits that Linux control groups, of version 2 or 1, set on this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

ROOT = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")


def cpu_quota(root: Path = ROOT, own: Path = OWN) -> float | None:
    """Cores that the control groups grant, the least of all levels; None without a limit.

    Args:
        root: where the control groups are mounted.
        own: file that names those of the process.
    """
    quotas = []
    for folder in _folders("cpu", root, own):
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
            with suppress(OSError, ValueError):
                quota, period = " ".join((folder / n).read_text(encoding="ascii") for n in names).split()
                if quota not in ("max", "-1"):
                    quotas.append(int(quota) / int(period))
    return min(quotas, default=None)


def memory_limit(root: Path = ROOT, own: Path = OWN) -> int | None:
    """Bytes that the control groups grant, the least of all levels; None without a limit."""
    limits = []
    for folder in _folders("memory", root, own):
        for name in ("memory.max", "memory.limit_in_bytes"):
            with suppress(OSError, ValueError):  # "max", or a group that is not seen from here
                limits.append(int((folder / name).read_text(encoding="ascii")))
    return min(limits, default=None)


def _folders(controller: str, root: Path, own: Path) -> Iterator[Path]:
    """Folders of the process's groups and of those around them."""
    try:
        lines = own.read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        mounts = [root / controllers, root / controller] if controllers else [root, root / "unified"]
        inside = PurePosixPath(path.lstrip("/"))
        for mount in mounts:
            yield from (mount / group for group in (inside, *inside.parents))
