"""Best and second best values of a block, and remarks on values that cannot be ranked."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from econgs_bench.reports.schema import METRICS
from econgs_bench.reports.sections.paper.values import QUANTITIES, PaperRow
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.tables.ranks import UNDECIDED_NOTE, leads, top_two
from econgs_bench.reports.tables.table import UNDECIDED, UNDECIDED_SIGN

SEEDS_NOTE = f"{UNDECIDED_SIGN} of size, time and speed: the ranges of their seeds overlap."


def marks(
    rows: Sequence[PaperRow], columns: Sequence[str], views: Views
) -> tuple[dict[tuple[int, str], int], list[str]]:
    """(row, column) -> place among the rows with equal :attr:`PaperRow.rivals`, and remarks.

    Quality is ranked where paired differences over views decide. Other columns are ranked by their values,
    unless the ranges of seeds overlap; times are of one place (:mod:`.reports.comparability`).
    """
    places: dict[tuple[int, str], int] = {}
    notes: dict[str, dict[str, None]] = {}
    for name, rivals in product(columns, dict.fromkeys(row.rivals for row in rows)):
        quantity = QUANTITIES[name]
        measured = {
            i: row for i, row in enumerate(rows) if row.rivals == rivals and row.values[name].mean is not None
        }
        texts = {f"{row.values[name].mean:.{quantity.digits}f}" for row in measured.values()}
        if not quantity.better or len(texts) < 2:
            continue
        if name in METRICS:
            lacking = [row.label for row in measured.values() if views.sample(row.jobs, name) is None]
            if lacking:
                labels = "" if len(lacking) == len(measured) else f" ({', '.join(lacking)})"
                note = f"ranked by means alone where there are no views to pair{labels}."
                notes.setdefault(note, {})[quantity.title] = None
        column = _places(measured, name, views)
        if UNDECIDED in column.values():
            notes[UNDECIDED_NOTE if name in METRICS else SEEDS_NOTE] = {}
        places |= {(i, name): place for i, place in column.items()}
    return places, [f"{', '.join(titles)}: {note}" if titles else note for note, titles in notes.items()]


def _places(rows: dict[int, PaperRow], name: str, views: Views) -> dict[int, int]:
    quantity = QUANTITIES[name]
    order = sorted(rows, key=lambda i: -quantity.better * float(rows[i].values[name].mean or 0.0))

    def ahead(first: int, second: int) -> bool:
        a, b = rows[order[first]], rows[order[second]]
        if name in METRICS:
            return leads(views, a.jobs, b.jobs, name)
        return _disjoint(a.values[name].seeds, b.values[name].seeds)

    texts = [f"{rows[i].values[name].mean:.{quantity.digits}f}" for i in order]
    return {order[position]: place for position, place in top_two(texts, ahead).items()}


def _disjoint(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether the ranges of two rows' seeds do not overlap; a single seed has no range."""
    return min(len(a), len(b)) < 2 or max(a) < min(b) or max(b) < min(a)
