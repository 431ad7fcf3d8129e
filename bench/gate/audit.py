"""Numbers that must follow from others: means from views, bytes from ledgers."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from econgs_bench.bench.gate.cells import Key
from econgs_bench.bench.gate.verdict import Finding
from econgs_bench.reports.schema import COVERAGE, METRICS
from econgs_bench.reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

_ROUNDING = 1e-6


def audit(tables: Mapping[str, pd.DataFrame]) -> Iterator[Finding]:
    """A finding for each number of a row that is not what its parts make.

    Args:
        tables: of a store, as readers get them.
    """
    views = dict(list(tables["views"].groupby("job", sort=False)))
    groups: dict[tuple[Any, ...], list[dict[Any, Any]]] = defaultdict(list)
    for row in tables["results"].to_dict("records"):
        if row["status"] != "ok":
            continue
        for text in _means(row, views.get(row["job"])):
            yield Finding("worse", Key.of(row).title, text)
        if row["kind"] == "basic":
            groups[(*Key.of(row)._replace(scene=""), row["seed"], row["group"])].append(row)
    for rows in groups.values():
        for text in _shares(rows):
            yield Finding("worse", Key.of(rows[0]).title, text)


def _means(row: Mapping[Any, Any], views: pd.DataFrame | None) -> Iterator[str]:
    """Quality is the mean over all views."""
    for name in (*METRICS, *COVERAGE):
        if absent(row[name]):
            continue
        values = [] if views is None else [value for value in views[name].tolist() if not absent(value)]
        mean = math.fsum(values) / len(values) if values else math.nan
        if not math.isclose(mean, row[name], rel_tol=_ROUNDING, abs_tol=_ROUNDING):
            yield f"{name} is {row[name]:.6g}, but the mean of its {len(values)} views is {mean:.6g}"


def _shares(rows: list[dict[Any, Any]]) -> Iterator[str]:
    """The shares of the scenes of a group make up what the group takes."""
    fitted = json.loads(rows[0]["fitted_scenes"] or "[]")
    if {row["scene"] for row in rows} != set(fitted):
        return  # not all of its scenes were measured
    for part, whole in (("size_bytes", "group_bytes"), ("train_seconds", "group_seconds")):
        if any(absent(row[name]) for row in rows for name in (part, whole)):
            continue
        total = math.fsum(row[part] for row in rows)
        if not math.isclose(total, rows[0][whole], rel_tol=_ROUNDING):
            yield f"{part} of its {len(rows)} scenes sum to {total:.6g}, {whole} is {rows[0][whole]:.6g}"
