"""Descendants of a process that outlive their parents, on Linux."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SET_CHILD_SUBREAPER, _GET_CHILD_SUBREAPER = 36, 37  # linux/prctl.h


@contextmanager
def adopting() -> Iterator[None]:
    """For as long as this lasts, orphans among this process's descendants become its children."""
    previous = _adopt_orphans(1)
    try:
        yield
    finally:
        _adopt_orphans(previous)


def _adopt_orphans(value: int) -> int:
    """Set whether orphans of descendants become children of this process; returns what was set before."""
    if sys.platform != "linux":
        return 0
    library, previous = ctypes.CDLL(None), ctypes.c_int()
    library.prctl(_GET_CHILD_SUBREAPER, ctypes.byref(previous), 0, 0, 0)
    library.prctl(_SET_CHILD_SUBREAPER, value, 0, 0, 0)
    return previous.value
