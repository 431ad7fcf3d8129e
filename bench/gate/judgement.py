"""A store judged by a baseline file."""

from __future__ import annotations

from pathlib import Path

from bench.gate.audit import audit
from bench.gate.baseline import Baseline, read
from bench.gate.cells import cells_of
from bench.gate.verdict import Verdict, compare
from bench.store import Store
from bench.tables import build_tables


def judged(path: Path, root: Path, *, times: bool = True) -> tuple[Verdict, Baseline]:
    """Verdict and baseline.

    Args:
        path: the baseline file.
        root: the run store.
        times: whether times are asked for.

    Raises:
        DataError: one of them cannot be read.
    """
    baseline = read(path)
    store = Store(root)
    tables = build_tables(store, write=False)
    verdict = compare(baseline, cells_of(store, tables), times=times)
    verdict.add(audit(tables))
    return verdict, baseline
