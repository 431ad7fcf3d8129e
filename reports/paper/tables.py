"""The paper's tables in its own layout: what was measured here, and under it what was published."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from reports.paper.layouts import layouts, published_as, reference, sole_dataset, takes
from reports.paper.marks import marks
from reports.paper.values import NOT_MEASURED, QUANTITIES, Block, PaperTable, Quantity, Row, Value
from reports.schema import METRICS
from reports.statistics import Views
from reports.style import absent
from reports.tables.protocols import shared_by_all, together, whole
from reports.tables.results import left_out

if TYPE_CHECKING:
    import pandas as pd

_LEAST_ROWS = 2  # of a block without published values of its own: one row compares nothing


def of_tables(tables: Mapping[str, pd.DataFrame]) -> list[PaperTable]:
    """:func:`paper_tables` of the documented tables."""
    return paper_tables(tables["results"], tables["views"], tables["timing"], tables.get("superseded"))


def paper_tables(
    results: pd.DataFrame,
    views: pd.DataFrame | None = None,
    timing: pd.DataFrame | None = None,
    superseded: pd.DataFrame | None = None,
) -> list[PaperTable]:
    """The tables that have something to compare: two measured rows, or one beside its published values.

    Args:
        results: see docs/concepts/architecture.md; edited rows and other rates than the default take
            no part. Quality and FPS are means over scenes, size, time and anchors are sums. In tables of one
            method those seeds count that all its rows have.
        views: the documented table, which decides whether quality can be ranked.
        timing: the documented table; without it there is none of frame times.
        superseded: the documented table; how many rows of a dataset are in it is told.
    """
    results = results[results["kind"].isin(("basic", "composed")) & results["rate"].isna()]
    if results.empty:
        return []
    results = _with_parts(results, timing)
    measured = Views(views) if views is not None and not views.empty else None
    tables = []
    for name, said in layouts()["tables"].items():
        blocks = [
            block
            for dataset, rows in _protocols(results, said)
            for block in _blocks(name, said, dataset, rows, measured, superseded)
        ]
        if blocks:
            tables.append(PaperTable(name, said["title"], said["head"], said["columns"], blocks))
    return tables


def _with_parts(results: pd.DataFrame, timing: pd.DataFrame | None) -> pd.DataFrame:
    """With the parts of a frame as columns, in milliseconds, and the number of views that were asked for."""
    results = results.copy()
    for column, part in (("decode_ms", "decode"), ("rasterise_ms", "rasterise"), ("frame_ms", "frame")):
        rows = timing[timing["part"] == part] if timing is not None and not timing.empty else None
        seconds = {} if rows is None else dict(zip(rows["job"], rows["seconds"], strict=True))
        results[column] = [1e3 * float(seconds[job]) if job in seconds else None for job in results["job"]]
    guessed = _requested(results["train_views"])
    told = results.get("requested_views", guessed)
    return results.assign(requested_views=told.fillna(guessed))


def _requested(views: pd.Series) -> pd.Series:
    """Training views as asked for, where a table does not tell: with split "val" a tenth was held out."""
    asked = (6, 12, 42, 92)
    return views.map(lambda n: n if absent(n) else min((a for a in asked if a >= n), default=n))


def _protocols(results: pd.DataFrame, said: dict[str, Any]) -> Iterator[tuple[str, pd.DataFrame]]:
    """Dataset and rows by protocol; with them those of parts of its scenes that were learned together."""
    keys = ["preset", "split"] if _by_views(said) else ["preset", "split", "requested_views"]
    wholes = results["dataset"].map(whole).rename("whole")
    for (dataset, *_), rows in results.groupby([wholes, *keys], dropna=False, sort=False):
        yield str(dataset), rows


def _by_views(said: dict[str, Any]) -> bool:
    return any("train_views" in line for line in said["rows"])


def _blocks(
    name: str,
    said: dict[str, Any],
    dataset: str,
    results: pd.DataFrame,
    views: Views | None,
    superseded: pd.DataFrame | None,
) -> Iterator[Block]:
    """One per published dataset that this one is or imitates, as far as all its scenes are there."""
    found = []
    for published, about in published_as(name, dataset).items():
        rows = _of_published(results, dataset, about)
        if rows.loc[rows["kind"] == "basic", "scene"].nunique() == about["count"]:
            found.append((published, about, rows))
    if not found and takes(name, dataset):
        found.append((sole_dataset(name), {}, results[results["dataset"] == dataset]))
    for published, about, rows in found:
        block = _block(name, said, dataset, rows, published, about, views, superseded)
        if block is not None:
            yield block


def _of_published(results: pd.DataFrame, dataset: str, about: dict[str, Any]) -> pd.DataFrame:
    """The rows of those scenes that a published dataset has, learned with no others."""
    part = results["dataset"] == together(dataset, about["count"])
    named = results["scene"].map(lambda scene: fnmatch.fnmatch(str(scene), about.get("scenes", "*")))
    foreign = set(results.loc[~named & (results["kind"] == "basic"), "scene"])
    alone = results["group"].map(
        lambda group: absent(group) or foreign.isdisjoint(re.split("[+,]", str(group)))
    )
    composed = results["kind"] == "composed"
    models = results["method"].str.cat(results["variant"], sep="\n")
    others = (results["dataset"] == dataset) & ~models.isin(set(models[part]))
    return results[part | (others & (named | composed) & alone)]


def _block(
    name: str,
    said: dict[str, Any],
    dataset: str,
    results: pd.DataFrame,
    published: str,
    about: dict[str, Any],
    views: Views | None,
    superseded: pd.DataFrame | None,
) -> Block | None:
    """None if nothing is to be compared."""
    columns = said["columns"]
    lines, seeds_told = _rows(name, said, results, published)
    measured = [
        line
        for line, row in zip(said["rows"], lines, strict=True)
        if any(value.mean is not None for value in row.values.values())
    ]
    same = dataset in about.get("real", ())
    compared = {(line["method"], line.get("variant"), line.get("train_views")) for line in measured}
    if len(compared) < (1 if same or "scene" in said["rows"][0] else _LEAST_ROWS):
        return None
    if _by_views(said) and not about and len({line["train_views"] for line in measured}) < _LEAST_ROWS:
        return None  # says nothing about the number of views
    shown = [row for row in lines if row.note != NOT_MEASURED or _has_published(row)]
    places, remarks = marks(shown, columns, views)
    first = results.iloc[0]
    count = results.loc[results["kind"] == "basic", "scene"].nunique()
    scenes = f"{count} {'scene' if count == 1 else 'scenes'}, preset {first['preset']}, "
    scenes += f"{first['split']} views of {first['width']} \N{MULTIPLICATION SIGN} {first['height']}"
    protocol = [str(first["preset"])] + ([str(first["split"])] if first["split"] != "test" else [])
    if not _by_views(said) and not absent(first["requested_views"]):
        scenes += f", {first['requested_views']} training views"
        protocol.append(f"{first['requested_views']} views")
    methods = {line["label"]: line["method"] for line in said["rows"]}
    if "rasterise_ms" in columns:
        remarks = [*remarks, "Parts of a frame are timed one by one, so that they need not add up to it."]
    remarks = [*remarks, *seeds_told, *_why_missing(shown, columns), *_versions(shown, methods)]
    if superseded is not None:
        same_set = (superseded["dataset"].map(whole) == dataset) & (superseded["preset"] == first["preset"])
        remarks += [told for told in [left_out(superseded[same_set])] if told]
    return Block(dataset, published, same, scenes, shown, places, remarks, ", ".join(protocol))


def _has_published(row: Row) -> bool:
    return any(value.published is not None for value in row.values.values())


def _versions(rows: list[Row], methods: Mapping[str, str]) -> list[str]:
    """Where rows of one method are of several versions of its source: what differs may be the versions."""
    told = []
    for method in dict.fromkeys(methods.values()):
        by_source: dict[frozenset[str], list[str]] = {}
        for row in rows:
            if methods[row.label] == method and row.sources:
                by_source.setdefault(row.sources, []).append(row.label)
        if len(by_source) > 1:
            groups = "; ".join(", ".join(labels) for labels in by_source.values())
            told.append(f"Not all of one version of the method's source, but: {groups}.")
    return told


def _why_missing(rows: list[Row], columns: list[str]) -> list[str]:
    """Why columns are empty that should not be: of all rows that were measured, or a metric of some."""
    measured = [row for row in rows if row.jobs]
    told = []
    for column in columns:
        without = [row for row in measured if row.values[column].mean is None]
        if not without or (column not in METRICS and len(without) < len(measured)):
            continue
        who = "" if len(without) == len(measured) else f" of {', '.join(row.label for row in without)}"
        reasons = dict.fromkeys(row.missing[column] for row in without if column in row.missing)
        told.append(f"{QUANTITIES[column].title}{who}: not measured ({'; '.join(reasons) or 'no values'}).")
    return told


def _rows(
    name: str, said: dict[str, Any], results: pd.DataFrame, published: str
) -> tuple[list[Row], list[str]]:
    """The lines, and what to say of seeds.

    Where all lines are of one method they are of the seeds that they have in common, for seeds of one setting
    may lie further apart than settings do. Lines of several methods keep theirs, and it is told where those
    of one method differ.
    """
    every = [_by_seed(line, results) for line in said["rows"]]
    told = []
    methods = list(dict.fromkeys(line["method"] for line in said["rows"]))
    for method in methods:
        mine = [
            (line["label"], seeds)
            for line, (seeds, _) in zip(said["rows"], every, strict=True)
            if seeds and line["method"] == method
        ]
        shared = shared_by_all(seeds for _, seeds in mine)
        if all(shared == set(seeds) for _, seeds in mine):
            continue
        labels = ", ".join(label for label, _ in mine)
        if len(methods) > 1 or any(shared - set(seeds) for _, seeds in mine):
            of_each = "; ".join(f"{label}: {_numbers(seeds)}" for label, seeds in mine)
            told.append(f"Not all of the same seeds, but {of_each}.")
            continue
        told.append(
            f"Means of seed{'s' if len(shared) > 1 else ''} {_numbers(shared)}, which all have: {labels}."
        )
        for _, seeds in mine:
            for seed in set(seeds) - shared:
                del seeds[seed]
    columns = said["columns"]
    rows = [
        _row(line, columns, *found, reference(name, line.get("match"), published))
        for line, found in zip(said["rows"], every, strict=True)
    ]
    return rows, told


def _numbers(seeds: Iterable[Any]) -> str:
    return ", ".join(f"{seed}" for seed in sorted(seeds))


def _by_seed(line: dict[str, Any], results: pd.DataFrame) -> tuple[dict[Any, pd.DataFrame], list[str]]:
    """A line's rows by seed, as far as all scenes are there, and why others are not."""
    kind = results[results["kind"] == ("composed" if line.get("composed") else "basic")]
    if "scene" in line:
        kind = kind[kind["scene"] == line["scene"]]
    rows = kind[(kind["method"] == line["method"]) & (kind["variant"] == line.get("variant", ""))]
    if "train_views" in line:
        rows = rows[rows["requested_views"] == line["train_views"]]
    notes = [] if len(rows) else [NOT_MEASURED]
    # What all methods were asked for decides whether a seed is complete.
    wanted = set(kind["scene"])
    complete = {}
    for seed, part in rows.groupby("seed", dropna=False, sort=True):
        status = dict(zip(part["scene"], part["status"], strict=True))
        lacking = [
            f"{scene} {status.get(scene, 'not run')}" for scene in sorted(wanted) if status.get(scene) != "ok"
        ]
        if lacking:
            notes.append(f"seed {seed}: {', '.join(lacking)}")
        else:
            complete[seed] = part
    return complete, notes


def _row(
    line: dict[str, Any],
    columns: list[str],
    seeds: Mapping[Any, pd.DataFrame],
    notes: list[str],
    told: Mapping[str, str],
) -> Row:
    complete = list(seeds.values())
    return Row(
        line["label"],
        {c: _value([_of_dataset(p, c) for p in complete], told, QUANTITIES[c]) for c in columns},
        "; ".join(notes),
        [str(job) for part in complete for job in part["job"]],
        frozenset(
            tuple("" if absent(value) else str(value) for value in host)
            for part in complete
            for host in part[["machine", "device", "threads"]].itertuples(index=False)
        ),
        frozenset(
            str(source)
            for part in complete
            for source in part.get("source", [])
            if not absent(source) and source
        ),
        {column: why for part in complete for column, why in _reasons(part["reason"])},
    )


def _reasons(told: pd.Series) -> Iterator[tuple[str, str]]:
    """(metric, why it is missing) of `reason`: "metric: why" joined by "; "."""
    for text in told:
        for part in () if absent(text) else str(text).split("; "):
            metric, sign, why = part.partition(": ")
            if sign:
                yield metric, why


def _of_dataset(scenes: pd.DataFrame, column: str) -> float | None:
    """One number of a dataset's scenes, in the column's unit; None if any of them lacks it."""
    quantity = QUANTITIES[column]
    if column == "groups":
        return float(scenes["group"].nunique())
    values = scenes[column]
    if values.isna().any():
        return None
    return float(values.astype(float).agg(quantity.across)) * quantity.scale


def _value(seeds: list[float | None], told: Mapping[str, str], quantity: Quantity) -> Value:
    text = told.get(quantity.published, "")
    published = float(text) if text.replace(".", "", 1).isdigit() else None
    known = [value for value in seeds if value is not None]
    if not known or len(known) < len(seeds):
        return Value(None, published)
    return Value(sum(known) / len(known), published, tuple(known))
