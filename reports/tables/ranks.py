"""Best and second best values of a table, as far as views can tell them apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.comparability import left_out
from econgs_bench.reports.schema import COLUMNS, METRICS, records
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.table import UNDECIDED, UNDECIDED_SIGN

if TYPE_CHECKING:
    import pandas as pd


UNDECIDED_NOTE = (
    f"{UNDECIDED_SIGN}: not ranked against each other: the 95 % interval of their paired difference over "
    "views and seeds contains zero."
)
_RANKED = {name: column for name, column in COLUMNS.items() if column.better}
_AXES = ("dataset", "scene", "kind", "preset", "split", "seed")


def ranks(results: pd.DataFrame, views: Views | None = None) -> dict[tuple[Any, str], int]:
    """(row index, column) -> 1 for the best and 2 for the second best, where several methods share a scene.

    Only finished rows and values that are compared are ranked; values with the same text share a rank. Where
    the interval of the paired difference to the leading value contains zero, both are :data:`UNDECIDED`, and
    no later value has a mark.

    Args:
        results: the table `results`, or its :func:`~.reports.tables.means.summary`.
        views: the table `views`; without it, or where it lacks a row's job, means alone decide.
    """
    places: dict[tuple[Any, str], int] = {}
    axes = [axis for axis in _AXES if axis in results]
    finished = next((name for name in ("complete", "status") if name in results), None)
    if results.empty or not axes or finished is None:
        return places
    views = views or Views()
    names = [name for name in _RANKED if name in results]
    of_jobs = "jobs" if "jobs" in results else "job"
    out = left_out(results)
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    columns = results[[*axes, finished, of_jobs, *names]]
    for index, row in zip(results.index, records(columns), strict=True):
        if row[finished] is True or row[finished] == "ok":
            row["index"], row["jobs"] = index, row["jobs"] if of_jobs == "jobs" else (str(row["job"]),)
            key = tuple(None if absent(row[axis]) else row[axis] for axis in axes)
            groups.setdefault(key, []).append(row)
    for rows in groups.values():
        for name in names:
            rivals = [row for row in rows if not absent(row[name]) and (row["index"], name) not in out]
            for index, place in _places(rivals, name, views).items():
                places[index, name] = place
    return places


def _places(rivals: list[dict[str, Any]], name: str, views: Views) -> dict[Any, int]:
    better = _RANKED[name].better
    rivals = sorted(rivals, key=lambda row: -better * float(row[name]))

    def ahead(first: int, second: int) -> bool:
        return name not in METRICS or leads(views, rivals[first]["jobs"], rivals[second]["jobs"], name)

    places = top_two([_RANKED[name].text(row[name]) for row in rivals], ahead)
    return {rivals[position]["index"]: place for position, place in places.items()}


def top_two(texts: Sequence[str], ahead: Callable[[int, int], bool]) -> dict[int, int]:
    """Position -> place of the best and second best of values that are sorted from the best.

    Args:
        texts: the values for people; equal texts share a place. If all are equal there are no places.
        ahead: whether one position is reliably better than a later one.
    """
    places: dict[int, int] = {}
    rest = list(range(len(texts))) if len(set(texts)) > 1 else []
    for place in (1, 2):
        leaders = [position for position in rest if texts[position] == texts[rest[0]]]
        rest = rest[len(leaders) :]
        near = [position for position in rest if not all(ahead(leader, position) for leader in leaders)]
        places |= dict.fromkeys([*leaders, *near], UNDECIDED if near else place)
        if near or not rest:
            break
    return places


def leads(views: Views, first: Sequence[str], second: Sequence[str], name: str) -> bool:
    """Whether views confirm that the first model, whose mean is better, is better.

    Args:
        views: values by job; where they cannot be paired, the means decide.
        first: jobs of the first model.
        second: jobs of the other.
        name: the metric.
    """
    difference = views.difference(first, second, name)
    return difference is None or difference.lies(COLUMNS[name].better)
