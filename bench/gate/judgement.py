"""A store judged by a baseline file."""

from __future__ import annotations

from pathlib import Path

from econgs_bench.bench.gate.audit import audit
from econgs_bench.bench.gate.baseline import Baseline, read
from econgs_bench.bench.gate.cells import Cell, Key, cells_of
from econgs_bench.bench.gate.verdict import Verdict, compare
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.store import Store


def judged(path: Path, root: Path, *, times: bool = True) -> tuple[Verdict, Baseline, dict[Key, Cell]]:
    """Verdict, baseline, and the cells of the run.

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
    cells = cells_of(store, tables)
    verdict = compare(baseline, cells, times=times)
    verdict.add(audit(tables))
    return verdict, baseline, cells
