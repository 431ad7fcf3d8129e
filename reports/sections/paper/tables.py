"""The paper's tables in its own layout: measured values above the published ones."""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.clocks import Clocks
from econgs_bench.reports.comparability import compared, fixed_rays, judged, reason, remarks, replaced
from econgs_bench.reports.schema import METRICS, records
from econgs_bench.reports.sections.paper.layouts import (
    layouts,
    published_as,
    reference,
    rivals,
    sole_dataset,
    takes,
)
from econgs_bench.reports.sections.paper.marks import marks
from econgs_bench.reports.sections.paper.values import (
    NOT_MEASURED,
    QUANTITIES,
    Block,
    PaperRow,
    PaperTable,
    Quantity,
    Value,
    counted_once,
    parts,
)
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.protocols import shared_by_all
from econgs_bench.reports.tables.results import omissions

if TYPE_CHECKING:
    import pandas as pd

_LEAST_ROWS = 2  # rows of a block without published values of its own


def paper_tables(tables: Mapping[str, pd.DataFrame], views: Views) -> list[PaperTable]:
    """The paper's tables that have a comparison: two measured rows, or one beside its published values.

    Quality and FPS are means over scenes; size, time and anchors are sums. Edited rows and rows at a rate are
    ignored. A table of one method takes the seeds that all its rows have.

    Args:
        tables: the tables of :mod:`.reports.schema`: `results`; `timing`, for the table of frame times;
            `superseded`, for remarks.
        views: the table `views`, which decides whether quality can be ranked.
    """
    results = tables["results"]
    clocks, gone = Clocks(results), tables.get("superseded")
    results = results[results["kind"].isin(("basic", "composed")) & results["rate"].isna()]
    if results.empty:
        return []
    results = _with_parts(results, tables.get("timing"))
    papers = []
    for name, layout in layouts()["tables"].items():
        blocks = [
            block
            for dataset, own in _protocols(results, layout)
            for published, description, rows in _parts(name, dataset, own)
            for block in _block(name, layout, dataset, rows, published, description, views, clocks, gone)
        ]
        if blocks:
            papers.append(PaperTable(name, layout["title"], layout["head"], layout["columns"], blocks))
    return papers


def lacking(results: pd.DataFrame, names: Iterable[str] = ()) -> str:
    """Why there is none of these tables: what the nearest one lacks; "" where no row belongs to any.

    Args:
        results: the table of :mod:`.reports.schema`.
        names: of layouts; none: all.
    """
    results = results[results["kind"].isin(("basic", "composed")) & results["rate"].isna()]
    found = []
    for place, name in enumerate(names or layouts()["tables"]):
        layout = layouts()["tables"][name]
        for dataset, rows in results.groupby("dataset", sort=False):
            described = published_as(name, str(dataset))
            if not described and not takes(name, str(dataset)):
                continue
            models = set(zip(rows["method"], rows["variant"].fillna(""), strict=True))
            lines = [line for line in layout["rows"] if (line["method"], line.get("variant", "")) in models]
            if not lines:
                continue
            scenes = rows.loc[rows["kind"] == "basic", "scene"].nunique()
            needed = min((int(one["count"]) for one in described.values()), default=scenes)
            wants = [f"all {needed} scenes of {dataset} (here {scenes})"] if scenes < needed else []
            same = any(dataset in one.get("real", ()) for one in described.values())
            if not same and len({line["label"] for line in lines}) < _LEAST_ROWS:
                wants.append(f'two of its {len(layout["rows"])} rows (here "{lines[0]["label"]}")')
            if wants:
                text = f"{layout['title']}, of {dataset}: needs {' and '.join(wants)}"
                found.append((len(wants), -len(lines), place, text))
    return f"No table of the paper: {min(found)[-1]}." if found else ""


def _with_parts(results: pd.DataFrame, timing: pd.DataFrame | None) -> pd.DataFrame:
    """The results with columns of their own for what the paper's tables have.

    The parts of a frame, in milliseconds, of which rasterising includes shading; triangles of meshes; bytes
    of initial clouds.
    """
    columns: dict[str, Any] = {}
    parts = {"decode_ms": ("decode",), "rasterise_ms": ("shade", "rasterise"), "frame_ms": ("frame",)}
    for column, names in parts.items():
        rows = timing[timing["part"].isin(names)] if timing is not None and not timing.empty else None
        seconds = {} if rows is None else rows.groupby("job")["seconds"].sum().to_dict()
        columns[column] = [1e3 * float(seconds[job]) if job in seconds else None for job in results["job"]]
    mesh = results["method"] == "mesh"
    columns["triangles"] = results["primitives"].where(mesh)
    columns["init_bytes"] = [
        _start_bytes(points, json.loads(options) if isinstance(options, str) else {})
        for points, options in zip(results["start_points"], results["options"], strict=True)
    ]
    # A table of another tool may lack the number of views that was requested.
    columns["requested_views"] = results["requested_views"].fillna(results["train_views"])
    return results.assign(**columns)


def _start_bytes(points: Any, options: dict[str, Any]) -> float | None:
    """Bytes of the points that a fit starts from, as the paper counts them: positions of 12, colors of 3.

    Args:
        points: of the cloud that the fit was given.
        options: those that differ from the preset's.
    """
    start = options.get("start", "cloud")
    if start == "random":
        return 0.0
    if absent(points):
        return None
    asked = options.get("cloud_points") or points
    return float(min(points, asked) * (12 if start == "positions" else 15))


def _protocols(results: pd.DataFrame, layout: dict[str, Any]) -> Iterator[tuple[str, pd.DataFrame]]:
    """Dataset and rows of each protocol, with the rows of parts of its scenes that were trained jointly."""
    keys = ["preset", "split"] if _by_views(layout) else ["preset", "split", "requested_views"]
    for (dataset, *_), rows in results.groupby(["dataset", *keys], dropna=False, sort=False):
        yield str(dataset), rows


def _by_views(layout: dict[str, Any]) -> bool:
    return any("train_views" in line for line in layout["rows"])


def _parts(name: str, dataset: str, results: pd.DataFrame) -> list[tuple[str, dict[str, Any], pd.DataFrame]]:
    """Each published dataset that this one is or imitates, its description, and the rows of its scenes."""
    parts = []
    for published, description in published_as(name, dataset).items():
        rows = _of_published(results, description)
        if rows.loc[rows["kind"] == "basic", "scene"].nunique() == description["count"]:
            parts.append((published, description, rows))
    if not parts and takes(name, dataset):
        parts.append((sole_dataset(name), {}, results[results["scenes_together"].isna()]))
    return parts


def _of_published(results: pd.DataFrame, description: dict[str, Any]) -> pd.DataFrame:
    """The rows of the scenes of a published dataset, where no other scenes were trained with them."""
    part = (results["scenes_together"] == description["count"]).fillna(False)
    pattern = description.get("scenes", "*")
    member = results["scene"].map(lambda scene: fnmatch.fnmatch(str(scene), pattern))
    foreign = set(results.loc[~member & (results["kind"] == "basic"), "scene"])
    alone = results["fitted_scenes"].map(
        lambda scenes: absent(scenes) or foreign.isdisjoint(json.loads(scenes))
    )
    composed = results["kind"] == "composed"
    models = results["method"].str.cat(results["variant"], sep="\n")
    others = results["scenes_together"].isna() & ~models.isin(set(models[part]))
    rows: pd.DataFrame = results[part | (others & (member | composed) & alone)]
    return rows


def _block(
    name: str,
    layout: dict[str, Any],
    dataset: str,
    results: pd.DataFrame,
    published: str,
    description: dict[str, Any],
    views: Views,
    clocks: Clocks,
    superseded: pd.DataFrame | None,
) -> Iterator[Block]:
    """A block, if it has something to compare; its rows are judged by themselves."""
    columns = layout["columns"]
    same = dataset in description.get("real", ())
    alone = same or "scene" in layout["rows"][0] or len(layout["rows"]) == 1
    least = 1 if alone else _LEAST_ROWS
    there = set(zip(results["method"], results["variant"].fillna(""), strict=True))
    if len({_model(line) for line in layout["rows"] if _model(line)[:2] in there}) < least:
        return
    results, notes = _compared(layout, results, clocks)
    rows, seed_remarks = _rows(name, layout, results, published)
    measured = [
        line
        for line, row in zip(layout["rows"], rows, strict=True)
        if any(value.mean is not None for value in row.values.values())
    ]
    if len({_model(line) for line in measured}) < least:
        return
    several = len({line.get("train_views") for line in measured}) >= _LEAST_ROWS
    if _by_views(layout) and not description and not several:
        return  # one number of views does not answer the table's question
    rows = [row for row in rows if row.note != NOT_MEASURED or row.has_published]
    places, remarks = marks(rows, columns, views)
    first = results.iloc[0]
    count = results.loc[results["kind"] == "basic", "scene"].nunique()
    scenes = f"{count} {'scene' if count == 1 else 'scenes'}, preset {first['preset']}, "
    scenes += f"{first['split']} views of {first['width']} \N{MULTIPLICATION SIGN} {first['height']}"
    scenes += "".join(f", {rays}" for rays in [fixed_rays(records(results))] if rays)
    protocol = [str(first["preset"])] + ([str(first["split"])] if first["split"] != "test" else [])
    if not _by_views(layout) and not absent(first["requested_views"]):
        scenes += f", {first['requested_views']} training views"
        protocol.append(f"{first['requested_views']} views")
    methods = {line["label"]: line["method"] for line in layout["rows"]}
    if "rasterise_ms" in columns:
        remarks.append("Each part of a frame is timed alone, so that their sum can differ from the frame.")
    remarks += [*seed_remarks, *_missing_remarks(rows, columns), *_version_remarks(rows, methods)]
    remarks += notes
    if superseded is not None:
        same_set = (superseded["dataset"] == dataset) & (superseded["preset"] == first["preset"])
        remarks += filter(None, [replaced(superseded[same_set])])
    yield Block(dataset, published, same, scenes, rows, places, remarks, ", ".join(protocol), count)


def _model(line: Mapping[str, Any]) -> tuple[str, str, int | None]:
    """Method, variant and number of training views of a layout's line."""
    return line["method"], line.get("variant", ""), line.get("train_views")


def _compared(
    layout: dict[str, Any], results: pd.DataFrame, clocks: Clocks
) -> tuple[pd.DataFrame, list[str]]:
    """Results with what is compared among the rows of a layout's lines, and remarks on what is not."""
    import pandas as pd

    lines = {_model(line)[:2] for line in layout["rows"]}
    pairs = zip(results["method"], results["variant"].fillna(""), strict=True)
    own = pd.Series([pair in lines for pair in pairs], results.index, dtype=bool)
    rows = judged(results[own], clocks, ("dataset",))
    if rows.empty:
        return results, []
    every = pd.concat([compared({"results": rows})["results"], results[~own]]).sort_index()
    return every, [one.text for one in remarks(rows)]


def _version_remarks(rows: list[PaperRow], methods: Mapping[str, str]) -> list[str]:
    """A remark for each method with rows of several versions: differences may come from the versions."""
    remarks = []
    for method in dict.fromkeys(methods.values()):
        labels: dict[frozenset[str], list[str]] = {}
        for row in rows:
            if methods[row.label] == method and row.versions:
                labels.setdefault(row.versions, []).append(row.label)
        if len(labels) > 1:
            groups = "; ".join(", ".join(group) for group in labels.values())
            remarks.append(f"Rows of several versions of the method: {groups}.")
    return remarks


def _missing_remarks(rows: list[PaperRow], columns: list[str]) -> list[str]:
    """The reasons why a column is empty in all measured rows, or why some rows lack a metric."""
    measured = [row for row in rows if row.jobs]
    remarks = []
    for column in columns:
        without = [row for row in measured if row.values[column].mean is None]
        if not without or (column not in METRICS and len(without) < len(measured)):
            continue
        labels = "" if len(without) == len(measured) else f" of {', '.join(row.label for row in without)}"
        kinds: dict[str, list[str]] = {}  # a reason of each
        for text in dict.fromkeys(row.missing[column] for row in without if column in row.missing):
            kinds.setdefault(text.partition(":")[0], []).append(text)
        text = "; ".join(
            own[0] if len(own) == 1 else own[0].replace(": ", ": as ", 1) for own in kinds.values()
        )
        text = text or "no values"
        remarks.append(f"{QUANTITIES[column].title}{labels}: not measured ({text}).")
    return remarks


def _rows(
    name: str, layout: dict[str, Any], results: pd.DataFrame, published: str
) -> tuple[list[PaperRow], list[str]]:
    """The rows, and remarks on seeds.

    If all rows are of one method, they are means over the seeds that all of them have, because seeds of one
    setting can differ by more than settings do. Rows of several methods keep all seeds.
    """
    lines = layout["rows"]
    models = set(zip(results["method"], results["variant"], strict=True))
    fits = [_by_seed(line, results, models) for line in lines]
    remarks = []
    methods = list(dict.fromkeys(line["method"] for line in lines))
    for method in methods:
        measured = [
            (line["label"], seeds)
            for line, (seeds, _) in zip(lines, fits, strict=True)
            if seeds and line["method"] == method
        ]
        shared = shared_by_all(seeds for _, seeds in measured)
        if all(shared == set(seeds) for _, seeds in measured):
            continue
        if len(methods) > 1 or any(shared - set(seeds) for _, seeds in measured):
            continue
        labels = ", ".join(label for label, _ in measured)
        plural = "s" if len(shared) > 1 else ""
        remarks.append(f"Means over seed{plural} {_numbers(shared)}, which all rows have: {labels}.")
        for _, seeds in measured:
            for seed in set(seeds) - shared:
                del seeds[seed]
    rows = [
        _row(line, layout["columns"], seeds, notes, reference(name, line.get("match"), published))
        for line, (seeds, notes) in zip(lines, fits, strict=True)
    ]
    every = [(line["label"], seeds) for line, (seeds, _) in zip(lines, fits, strict=True)]
    return rows, [*remarks, *_fewer_seeds(every, layout["columns"])]


def _fewer_seeds(
    rows: Iterable[tuple[str, Mapping[Any, pd.DataFrame]]], columns: Iterable[str]
) -> Iterator[str]:
    """Remarks on columns that are means over fewer seeds than their row has."""
    rows = list(rows)
    for column in columns:
        labels: dict[str, list[str]] = {}
        for name, seeds in rows:
            lacking = [seed for seed, part in seeds.items() if _of_dataset(part, column) is None]
            if 0 < len(lacking) < len(seeds):
                plural = "s" if len(lacking) > 1 else ""
                labels.setdefault(f"without seed{plural} {_numbers(lacking)}", []).append(name)
        for text, names in labels.items():
            yield f"{QUANTITIES[column].title} {text}: {', '.join(names)}."


def _numbers(seeds: Iterable[Any]) -> str:
    return ", ".join(f"{seed}" for seed in sorted(seeds))


def _by_seed(
    line: dict[str, Any], results: pd.DataFrame, models: set[tuple[Any, Any]]
) -> tuple[dict[Any, pd.DataFrame], list[str]]:
    """The rows of a layout's line by seed, for seeds that have all scenes; notes on the other seeds.

    Args:
        line: of the layout.
        results: of one block.
        models: (method, variant) of all rows.
    """
    method, variant = line["method"], line.get("variant", "")
    if (method, variant) not in models:
        return {}, [NOT_MEASURED]
    model = (results["method"] == method) & (results["variant"] == variant)
    kind = results["kind"] == ("composed" if line.get("composed") else "basic")
    if "scene" in line:
        kind &= results["scene"].map(lambda scene: fnmatch.fnmatch(str(scene), line["scene"]))
    rows = results[kind & model]
    if "train_views" in line:
        rows = rows[rows["requested_views"] == line["train_views"]]
    notes = [] if len(rows) else [NOT_MEASURED]
    # A seed is complete if it has every scene of any method.
    scenes = set(results.loc[kind, "scene"])
    complete = {}
    for seed, part in rows.groupby("seed", dropna=False, sort=True):
        status = dict(zip(part["scene"], part["status"], strict=True))
        lacking = [
            f"{scene} {status.get(scene, 'not run')}" for scene in sorted(scenes) if status.get(scene) != "ok"
        ]
        if lacking:
            notes.append(f"seed {seed}: {', '.join(lacking)}")
        else:
            own = (results["kind"] == "basic") & model & results["seed"].eq(seed).fillna(False)
            complete[seed] = counted_once(part, results[own]) if line.get("composed") else part
    return complete, notes


def _row(
    line: dict[str, Any],
    columns: list[str],
    seeds: Mapping[Any, pd.DataFrame],
    notes: list[str],
    published: Mapping[str, str],
) -> PaperRow:
    complete = list(seeds.values())
    return PaperRow(
        line["label"],
        {c: _value([_of_dataset(part, c) for part in complete], published, QUANTITIES[c]) for c in columns},
        "; ".join(notes),
        [str(job) for part in complete for job in part["job"]],
        frozenset(
            str(version) for part in complete for version in part["method_version"] if not absent(version)
        ),
        {
            metric: why
            for part in complete
            for text in part["omissions"]
            for metric, why in omissions(text).items()
        }
        | {
            column: why
            for part in complete
            for row in records(part)
            for column in columns
            if (why := reason(row, column))
        },
        parts(seeds, columns),
        rivals(line),
    )


def _of_dataset(scenes: pd.DataFrame, column: str) -> float | None:
    """One number for a dataset's scenes, in the column's unit; None if a scene lacks it."""
    quantity = QUANTITIES[column]
    if column == "groups":
        return float(scenes["group"].nunique())
    values = scenes[column]
    if values.isna().any():
        return None
    return float(values.astype(float).agg(quantity.across)) * quantity.scale


def _value(seeds: list[float | None], published_row: Mapping[str, str], quantity: Quantity) -> Value:
    text = published_row.get(quantity.published, "")
    published = float(text) if text.replace(".", "", 1).isdigit() else None
    measured = [value for value in seeds if value is not None]
    if not measured:
        return Value(None, published)
    return Value(sum(measured) / len(measured), published, tuple(measured))
