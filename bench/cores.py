"""Cores of one machine, divided among the workers of a cluster that run on it (on Linux)."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from bench.timing import lock_file


@contextmanager
def machine_share(wait: bool) -> Iterator[None]:
    """Hold the lock of this machine together with others that time jobs on cores of their own.

    Raises:
        BlockingIOError: a process holds it alone, and ``wait`` is False.
    """
    with _lock(lock_file("timing"), fcntl.LOCK_SH | (0 if wait else fcntl.LOCK_NB)):
        yield


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
    with ExitStack() as claims, _lock(lock_file("cores"), fcntl.LOCK_EX):
        for core in usable:
            if len(cores) < min(count, len(usable)):
                try:
                    claims.enter_context(_lock(lock_file(f"core-{core}"), fcntl.LOCK_EX | fcntl.LOCK_NB))
                except BlockingIOError:
                    continue
                cores.add(core)
        if len(cores) < min(count, len(usable)):
            return None
        stack.push(claims.pop_all())
    return cores


@contextmanager
def _lock(path: Path, operation: int) -> Iterator[None]:
    """Hold a lock of the kernel on a file.

    Args:
        path: the file, made if it is not there.
        operation: flags of ``flock``.

    Raises:
        BlockingIOError: another process holds it, and the flags say not to wait.
    """
    while True:
        handle = os.open(path, os.O_RDONLY | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, operation)
            if os.fstat(handle).st_nlink:  # else a FileLock removed it meanwhile
                yield
                return
        finally:
            os.close(handle)
