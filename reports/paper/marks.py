"""Which values of a block are best and second best, as far as that can be told, and what to say of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from reports.paper.values import QUANTITIES, Row
from reports.schema import METRICS
from reports.statistics import Views
from reports.tables.ranks import UNDECIDED, UNDECIDED_NOTE, UNDECIDED_SIGN, standing, told_apart

SEEDS_NOTE = f"{UNDECIDED_SIGN} of size, time and speed: the ranges of their seeds overlap."
ELSEWHERE = "not ranked: measured on several machines, devices or numbers of threads."


def marks(
    rows: Sequence[Row], columns: Sequence[str], views: Views | None
) -> tuple[dict[tuple[int, str], int], list[str]]:
    """(row, column) -> place, and remarks.

    Quality is ranked as far as paired differences over views say so; other columns as measured, except where
    the ranges of seeds overlap, and times only where all were measured in one place.
    """
    places: dict[tuple[int, str], int] = {}
    notes: dict[str, list[str]] = {}
    for name in columns:
        quantity = QUANTITIES[name]
        known = {i: row.values[name] for i, row in enumerate(rows) if row.values[name].mean is not None}
        means = {i: float(value.mean or 0.0) for i, value in known.items()}
        texts = {i: f"{mean:.{quantity.digits}f}" for i, mean in means.items()}
        if not quantity.better or len(set(texts.values())) < 2:
            continue
        if quantity.clock and len({host for i in known for host in rows[i].hosts}) > 1:
            notes.setdefault(ELSEWHERE, []).append(quantity.title)
            continue
        if name in METRICS:
            samples = {i: views.sample(rows[i].jobs, name) if views else None for i in known}
            lacking = [rows[i].label for i in known if samples[i] is None]
            if lacking:
                who = "" if len(lacking) == len(known) else f" ({', '.join(lacking)})"
                told = f"ranked by means alone where there are no views to pair{who}."
                notes.setdefault(told, []).append(quantity.title)
            apart = partial(told_apart, samples, quantity.better)
        else:
            apart = partial(_by_seeds, {i: value.seeds for i, value in known.items()})
        order = sorted(means, key=means.__getitem__, reverse=quantity.better > 0)
        found = standing(order, texts, apart)
        if UNDECIDED in found.values():
            notes[UNDECIDED_NOTE if name in METRICS else SEEDS_NOTE] = []
        places |= {(i, name): place for i, place in found.items()}
    return places, [f"{', '.join(titles)}: {told}" if titles else told for told, titles in notes.items()]


def _by_seeds(seeds: Mapping[int, Sequence[float]], first: int, second: int) -> bool:
    """One seed's values are taken as they are: nothing tells how sure they are."""
    a, b = seeds[first], seeds[second]
    return min(len(a), len(b)) < 2 or max(a) < min(b) or max(b) < min(a)
