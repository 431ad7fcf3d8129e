"""Best and second best values of a table, as far as views can tell them apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from reports.schema import COLUMNS, METRICS
from reports.statistics import Sample, Views

if TYPE_CHECKING:
    import pandas as pd


UNDECIDED = 3
"""Mark of a value that is not ranked: the interval of its paired difference contains zero."""
UNDECIDED_SIGN = "\N{ALMOST EQUAL TO}"
UNDECIDED_NOTE = (
    f"{UNDECIDED_SIGN}: not ranked against each other: the 95 % interval of their paired difference over "
    "views contains zero."
)


def ranks(results: pd.DataFrame, views: pd.DataFrame | None = None) -> dict[tuple[Any, str], int]:
    """(row label, column) -> 1 for the best and 2 for the second best, where several methods share a scene.

    Only finished rows compete; equal values as shown share a rank. A quality metric is ranked by its mean
    over views only as far as these views say so: where the interval of the paired difference to the leading
    value contains zero, both are marked :data:`UNDECIDED` and nothing after them is marked.

    Args:
        results: the documented table, or its :func:`summary`.
        views: the documented table; without it (or where it lacks a row's job) means alone decide.
    """
    places: dict[tuple[Any, str], int] = {}
    by = [c for c in ("dataset", "scene", "kind", "preset", "split", "seed") if c in results]
    if results.empty or not by or not {"status", "complete"} & set(results.columns):
        return places
    measured = Views(views) if views is not None and not views.empty else None
    for _, group in results.groupby(by, dropna=False, sort=False):
        rivals = group[group["complete"]] if "complete" in group else group[group["status"] == "ok"]
        for name, column in COLUMNS.items():
            if not column.better or name not in rivals:
                continue
            values = rivals[name].dropna()
            texts = {index: column.text(value) for index, value in values.items()}
            order = sorted(values.index, key=lambda index: -column.better * float(values[index]))
            if len(values) < 2 or len(set(texts.values())) < 2:
                continue
            samples: dict[Any, Sample | None] = dict.fromkeys(order)
            if measured is not None and name in METRICS:
                samples = {index: measured.sample(_jobs(rivals.loc[index]), name) for index in order}
            apart = partial(told_apart, samples, column.better)
            for index, place in standing(order, texts, apart).items():
                places[index, name] = place
    return places


def standing(order: list[Any], texts: dict[Any, str], apart: Callable[[Any, Any], bool]) -> dict[Any, int]:
    """Places of rows that are ordered from the best.

    Args:
        order: the rows.
        texts: their values as shown; equal ones share a place.
        apart: whether a row and one after it can be told apart.
    """
    places: dict[Any, int] = {}
    rest = order
    for place in (1, 2):
        leaders = [index for index in rest if texts[index] == texts[rest[0]]]
        rest = rest[len(leaders) :]
        near = [index for index in rest if not all(apart(leader, index) for leader in leaders)]
        places |= dict.fromkeys([*leaders, *near], UNDECIDED if near else place)
        if near or not rest:
            break
    return places


def told_apart(samples: Mapping[Any, Sample | None], better: int, first: Any, second: Any) -> bool:
    """Whether views say too that the first is better; where they are not at hand it is taken as it is.

    Args:
        samples: of all rows.
        better: 1 if more is, -1 if less is.
        first: the row whose mean is better.
        second: the other.
    """
    a, b = samples[first], samples[second]
    if a is None or b is None:
        return True
    difference = a.minus(b)
    return difference is None or difference.lies(better)


def _jobs(row: Any) -> list[str]:
    """Of a row of `results` or its summary."""
    return list(row["jobs"]) if "jobs" in row else [str(row["job"])]
