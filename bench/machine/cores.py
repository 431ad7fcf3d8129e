"""Cores of one machine, divided among the workers of a cluster that run on it (on Linux)."""

from __future__ import annotations

import os
from contextlib import ExitStack

from econgs_bench.bench.machine.locks import locked


def claim_cores(count: int, stack: ExitStack) -> set[int] | None:
    """Claim cores that no other process has claimed, of those that this one may use.

    Args:
        count: how many; at most as many as this process may use.
        stack: holds the claim; the system ends it with the process.

    Returns:
        Their numbers; None if too few are left, or the system pins no processes.
    """
    if not hasattr(os, "sched_setaffinity"):
        return None
    usable = sorted(os.sched_getaffinity(0))
    cores: set[int] = set()
    with ExitStack() as claims, locked("cores"):
        for core in usable:
            if len(cores) < min(count, len(usable)):
                try:
                    claims.enter_context(locked(f"core-{core}", wait=False))
                except BlockingIOError:
                    continue
                cores.add(core)
        if len(cores) < min(count, len(usable)):
            return None
        stack.push(claims.pop_all())
    return cores
