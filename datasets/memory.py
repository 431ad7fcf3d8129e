"""Peak memory of a process."""

from __future__ import annotations

import sys
from pathlib import Path


def peak_host_bytes(process: int | None = None) -> int | None:
    """High-water mark of a process's resident memory (VmHWM), in bytes; None where unknown.

    ``ru_maxrss`` would be inherited across exec from a larger parent.

    Args:
        process: its number; None: this process.
    """
    place = Path("/proc", "self" if process is None else str(process), "status")
    try:
        for line in place.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return None


def peak_drjit_device_bytes() -> int | None:
    """Peak memory of Dr.Jit on a CUDA device, in bytes; None if it used none."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return None
    return int(drjit.detail.malloc_watermark(drjit.JitBackend.CUDA)) or None
