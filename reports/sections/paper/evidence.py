"""Tables for those of the paper's claims that its tables do not decide: curves, volumes and the data."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.curves import Curve
from econgs_bench.reports.schema import frame
from econgs_bench.reports.sections.paper.layouts import known_as
from econgs_bench.reports.sections.paper.values import QUANTITIES, Block, PaperRow, PaperTable, Value
from econgs_bench.reports.sections.rates.conclusion import difference
from econgs_bench.reports.style import TITLES, Model, label

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.report import Report

OURS = Model("econgs")
LAYOUTS = {
    "curves": ("Rate-distortion curves: ECoNGS-R against others", [*TITLES.values()], ["bd_psnr"]),
    "volumes": ("Direct rendering of the volumes", ["volume"], ["fps"]),
    "data": ("Data", ["data"], ["scenes", "variables", "cloud_seconds"]),
}
"""Name of a table -> title, labels of rows, and columns."""


def evidence(
    curves: Mapping[str, Sequence[Curve]], dvr: pd.DataFrame, scenes: pd.DataFrame
) -> list[PaperTable]:
    """The tables of :data:`LAYOUTS` that have blocks.

    Args:
        curves: dataset -> its rate-distortion curves.
        dvr: the table `dvr`.
        scenes: the table `scenes`.
    """
    blocks = {"curves": _of_curves(curves), "volumes": _of_volumes(dvr), "data": _of_data(scenes)}
    tables = [
        PaperTable(name, title, "", columns, list(blocks[name]))
        for name, (title, _, columns) in LAYOUTS.items()
    ]
    return [table for table in tables if table.blocks]


def of_report(report: Report) -> list[PaperTable]:
    """The same of a report."""
    scenes = report.stored["scenes"] if "scenes" in report.stored else frame("scenes")
    return evidence(report.curves, report.stored["dvr"], scenes)


def _of_curves(panels: Mapping[str, Sequence[Curve]]) -> Iterator[Block]:
    """BD-PSNR of ECoNGS-R against each other method, all at their default options."""
    for name, curves in panels.items():
        ours = next((curve for curve in curves if curve.model == OURS), None)
        others = [curve for curve in curves if curve.model != OURS and not curve.model.options]
        rows = [
            _row(label(other.model.method), bd_psnr=difference(other, ours).psnr) for other in others if ours
        ]
        if ours is None or not rows:
            continue
        # The name of a panel has the number of scenes or of views where there are several.
        first = ours.points[0].row
        dataset, preset = name.partition(",")[0].partition(" \N{MIDDLE DOT} ")[0], str(first["preset"])
        count = len(first["jobs"]) // int(first["seeds"])
        known = [one for one, facts in known_as(dataset).items() if facts["count"] == count]
        published = known[0] if known else ""
        same = bool(published) and dataset in known_as(dataset)[published].get("real", ())
        yield Block(name, published, same, "", rows, {}, (), preset, count)


def _of_volumes(dvr: pd.DataFrame) -> Iterator[Block]:
    """Frame rate of direct rendering, mean over basic scenes that were all rendered."""
    basic = dvr[dvr["kind"] == "basic"]
    keys = ["dataset", "preset", "processor", "threads"]
    for (dataset, preset, *_), rows in basic.groupby(keys, sort=False, dropna=False):
        for published, same, part in _parts(str(dataset), rows):
            fine = part["status"].eq("ok").all()
            fps = float(part["fps"].mean()) if fine else None
            yield _block(str(dataset), published, same, str(preset), part, fps=fps)


def _of_data(scenes: pd.DataFrame) -> Iterator[Block]:
    """Number of basic scenes and of their variables, and the longest time that an initial cloud took."""
    basic = scenes[scenes["cloud_seconds"].notna()]
    keys = ["dataset", "preset", "split", "requested_views"]
    for (dataset, preset, *_), rows in basic.groupby(keys, dropna=False, sort=False):
        for published, same, part in _parts(str(dataset), rows):
            yield _block(
                str(dataset), published, same, str(preset), part,
                scenes=float(part["scene"].nunique()), variables=float(part["variable"].nunique()),
                cloud_seconds=float(part["cloud_seconds"].max()),
            )  # fmt: skip


def _parts(dataset: str, rows: pd.DataFrame) -> Iterable[tuple[str, bool, pd.DataFrame]]:
    """Each published dataset that these scenes hold, whether it is theirs, and the rows of its scenes.

    All rows where they hold none.
    """
    parts = []
    for published, facts in known_as(dataset).items():
        pattern = facts.get("scenes", "*")
        part = rows[[fnmatch.fnmatch(str(scene), pattern) for scene in rows["scene"]]]
        if part["scene"].nunique() == facts["count"]:
            parts.append((published, dataset in facts.get("real", ()), part))
    return parts or [("", False, rows)]


def _block(
    dataset: str, published: str, same: bool, protocol: str, rows: pd.DataFrame, **values: float | None
) -> Block:
    name = "volume" if "fps" in values else "data"
    count = int(rows["scene"].nunique())
    return Block(dataset, published, same, "", [_row(name, **values)], {}, (), protocol, count)


def _row(name: str, **values: Any) -> PaperRow:
    cells = {
        column: Value(None if value is None else value * QUANTITIES[column].scale)
        for column, value in values.items()
    }
    return PaperRow(name, cells)
