"""The paper's tables in its own layout: what was measured here, and under it what was published."""

from __future__ import annotations

import csv
import fnmatch
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reports.statistics import METRICS, Views
from reports.style import MIB, absent
from reports.tables import standing

if TYPE_CHECKING:
    import pandas as pd

_FOLDER = Path(__file__).parent / "published"
_LEAST_ROWS = 2  # of a block without published values of its own: one row compares nothing


@dataclass(frozen=True)
class Quantity:
    """A column: its header, where its published value stands and what brings measured values to its unit."""

    title: str
    published: str
    digits: int
    better: int = 0  # 1: more is better, -1: less is
    scale: float = 1.0


QUANTITIES = {
    "psnr": Quantity("PSNR [dB]", "psnr", 2, 1),
    "lpips_vgg": Quantity("LPIPS", "lpips_vgg", 3, -1),
    "fps": Quantity("FPS", "fps", 2, 1),
    "train_seconds": Quantity("Training [min]", "train_min", 2, -1, 1.0 / 60.0),
    "size_bytes": Quantity("Size [MiB]", "size_mib", 2, -1, 1.0 / MIB),
    "primitives": Quantity("Anchors", "anchors", 0, -1),
    "groups": Quantity("Groups", "groups_derived", 0),
    "partition_seconds": Quantity("Clustering [s]", "clustering_s", 2),
    "decode_ms": Quantity("Decoding [ms]", "mlp_ms", 2, -1),
    "rasterise_ms": Quantity("Rasterising [ms]", "raster_ms", 2, -1),
    "frame_ms": Quantity("Frame [ms]", "total_ms", 2, -1),
    "peak_host_bytes": Quantity("Host memory [GiB]", "", 2, -1, 1.0 / 2.0**30),
}
_ACROSS_SCENES = {
    "train_seconds": "sum",
    "size_bytes": "sum",
    "primitives": "sum",
    "peak_host_bytes": "max",
}


@dataclass(frozen=True)
class Value:
    """One cell.

    Attributes:
        mean: over seeds, in the column's unit; None if it is missing.
        spread: standard deviation over seeds; None for a single one.
        published: the paper's value; None if it has none.
    """

    mean: float | None
    spread: float | None = None
    published: float | None = None


@dataclass(frozen=True)
class Row:
    """A line of a table; ``note`` says why its cells are missing, ``jobs`` what they were measured by."""

    label: str
    values: Mapping[str, Value]
    note: str = ""
    jobs: Sequence[str] = ()


@dataclass(frozen=True)
class Block:
    """The rows of one dataset under one protocol.

    Attributes:
        dataset: its name here.
        published: name in the paper of the dataset that the published values belong to; "": none.
        same: whether that is this very dataset. Differences are given only then.
        scenes: how many of the dataset's scenes were measured, and how, for people.
        marks: (row, column) -> 1 for the best, 2 for the second best measured value, or
            :data:`reports.tables.UNDECIDED` where the views cannot tell them apart.
    """

    dataset: str
    published: str
    same: bool
    scenes: str
    rows: Sequence[Row]
    marks: Mapping[tuple[int, str], int]


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables with as many blocks as datasets were measured; ``head`` names its rows."""

    name: str
    title: str
    head: str
    columns: Sequence[str]
    blocks: Sequence[Block] = field(default_factory=list)


@cache
def layouts() -> dict[str, Any]:
    """What ``published/tables.toml`` says."""
    return tomllib.loads((_FOLDER / "tables.toml").read_text(encoding="utf-8"))


@cache
def reference_rows(name: str) -> list[dict[str, str]]:
    """The rows of ``published/NAME.csv``."""
    with (_FOLDER / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def paper_tables(
    results: pd.DataFrame, views: pd.DataFrame | None = None, timing: pd.DataFrame | None = None
) -> list[PaperTable]:
    """The tables that have something to compare: two measured rows, or one beside its published values.

    Args:
        results: as documented in docs/architecture.md; composed rows and other rates than the default take
            no part. Quality and FPS are means over scenes, size, time and anchors are sums.
        views: the documented table, which decides whether quality can be ranked.
        timing: the documented table; without it there is none of frame times.
    """
    results = _with_parts(results, timing)
    measured = Views(views) if views is not None and not views.empty else None
    plain = results[(results["kind"] == "basic") & results["rate"].isna()]
    if plain.empty:
        return []
    tables = []
    for name, said in layouts()["tables"].items():
        blocks = [
            block
            for dataset, rows in plain.groupby("dataset", sort=False)
            for block in _blocks(name, said, str(dataset), rows, measured)
        ]
        if blocks:
            tables.append(PaperTable(name, said["title"], said["head"], said["columns"], blocks))
    return tables


def _with_parts(results: pd.DataFrame, timing: pd.DataFrame | None) -> pd.DataFrame:
    """With the parts of a frame as columns, in milliseconds."""
    results = results.copy()
    for column, part in (("decode_ms", "decode"), ("rasterise_ms", "rasterise"), ("frame_ms", "frame")):
        rows = timing[timing["part"] == part] if timing is not None and not timing.empty else None
        seconds = {} if rows is None else dict(zip(rows["job"], rows["seconds"], strict=True))
        results[column] = [1e3 * float(seconds[job]) if job in seconds else None for job in results["job"]]
    return results


def _blocks(
    name: str, said: dict[str, Any], dataset: str, results: pd.DataFrame, views: Views | None
) -> Iterator[Block]:
    """One per published dataset that this one is or imitates, and per protocol (preset, split, views)."""
    references = [row["dataset"] for row in reference_rows(name)]
    sole = references[0] if len(set(references)) == 1 else ""
    of_paper = {
        published: about
        for published, about in layouts()["datasets"].items()
        if dataset in (*about["real"], *about["stand_ins"])
    }
    if "only" in said and of_paper and set(said["only"]).isdisjoint(of_paper):
        return  # the paper's, but for another of its tables
    known = [(one, about) for one, about in of_paper.items() if one in said.get("only", references)]
    found = 0
    for published, about in known:
        rows = results[[fnmatch.fnmatch(str(scene), about.get("scenes", "*")) for scene in results["scene"]]]
        if rows["scene"].nunique() == about["count"]:
            for block in _of_protocols(name, said, dataset, rows, published, about, views):
                found += 1
                yield block
    if not found:
        yield from _of_protocols(name, said, dataset, results, sole, {}, views)


def _of_protocols(
    name: str,
    said: dict[str, Any],
    dataset: str,
    results: pd.DataFrame,
    published: str,
    about: dict[str, Any],
    views: Views | None,
) -> Iterator[Block]:
    by_views = any("train_views" in row for row in said["rows"])
    keys = ["preset", "split"] if by_views else ["preset", "split", "requested_views"]
    guessed = _requested(results["train_views"])
    told = results.get("requested_views", guessed)
    results = results.assign(requested_views=told.fillna(guessed))
    for _, rows in results.groupby(keys, dropna=False, sort=False):
        lines = [_row(name, line, said["columns"], rows, published) for line in said["rows"]]
        measured = {
            (said_line["method"], said_line.get("variant"), said_line.get("train_views"))
            for line, said_line in zip(lines, said["rows"], strict=True)
            if any(value.mean is not None for value in line.values.values())
        }
        if by_views and not about and len({views for *_, views in measured}) < _LEAST_ROWS:
            continue  # says nothing about the number of views
        same = dataset in about.get("real", ())
        lines = [line for line in lines if line.note != "not measured" or _has_published(line)]
        if len(measured) < (1 if same else _LEAST_ROWS):
            continue
        first = rows.iloc[0]
        scenes = f"{rows['scene'].nunique()} scenes, preset {first['preset']}, {first['split']} views of "
        scenes += f"{first['width']} \N{MULTIPLICATION SIGN} {first['height']}"
        yield Block(dataset, published, same, scenes, lines, _marks(lines, said["columns"], views))


def _marks(rows: Sequence[Row], columns: Sequence[str], views: Views | None) -> dict[tuple[int, str], int]:
    marks: dict[tuple[int, str], int] = {}
    for name in columns:
        quantity = QUANTITIES[name]
        means = {i: row.values[name].mean for i, row in enumerate(rows)}
        known = {i: mean for i, mean in means.items() if mean is not None}
        texts = {i: f"{mean:.{quantity.digits}f}" for i, mean in known.items()}
        if not quantity.better or len(set(texts.values())) < 2:
            continue
        order = sorted(known, key=lambda i: -quantity.better * known[i])
        samples = {i: views.sample(rows[i].jobs, name) if views and name in METRICS else None for i in known}
        marks |= {(i, name): place for i, place in standing(order, texts, samples).items()}
    return marks


def _has_published(row: Row) -> bool:
    return any(value.published is not None for value in row.values.values())


def _requested(views: pd.Series) -> pd.Series:
    """Training views as asked for, where a table does not tell: with split "val" a tenth was held out."""
    asked = (6, 12, 42, 92)
    return views.map(lambda n: n if absent(n) else min((a for a in asked if a >= n), default=n))


def _row(
    name: str, line: dict[str, Any], columns: Sequence[str], results: pd.DataFrame, published: str
) -> Row:
    rows = results[(results["method"] == line["method"]) & (results["variant"] == line.get("variant", ""))]
    if "train_views" in line:
        rows = rows[rows["requested_views"] == line["train_views"]]
    reference = _reference(name, line.get("match"), published)
    note = "" if len(rows) else "not measured"
    # Each seed on its own, so that every column has its spread; what all methods were asked for decides
    # whether a seed is complete.
    wanted = set(results["scene"])
    per_seed: dict[str, list[float]] = {column: [] for column in columns}
    for seed, part in rows.groupby("seed", dropna=False, sort=True):
        lacking = wanted - set(part.loc[part["status"] == "ok", "scene"])
        if lacking:
            note = f"seed {seed}: {', '.join(sorted(lacking))} missing or failed"
            continue
        for column in columns:
            value = _of_dataset(part, column)
            if value is not None:
                per_seed[column].append(value * QUANTITIES[column].scale)
    return Row(
        line["label"],
        {c: _value(per_seed[c], reference, QUANTITIES[c]) for c in columns},
        note,
        list(rows["job"]),
    )


def _of_dataset(scenes: pd.DataFrame, column: str) -> float | None:
    """One number of a dataset's scenes; None if any of them lacks it."""
    if column == "groups":
        return float(scenes["group"].nunique())
    values = scenes[column]
    if values.isna().any():
        return None
    return float(values.astype(float).agg(_ACROSS_SCENES.get(column, "mean")))


def _value(seeds: list[float], reference: Mapping[str, str], quantity: Quantity) -> Value:
    text = reference.get(quantity.published, "")
    told = float(text) if text.replace(".", "", 1).isdigit() else None
    if not seeds:
        return Value(None, None, told)
    mean = sum(seeds) / len(seeds)
    if len(seeds) == 1:
        return Value(mean, None, told)
    return Value(mean, (sum((x - mean) ** 2 for x in seeds) / (len(seeds) - 1)) ** 0.5, told)


def _reference(name: str, match: dict[str, str] | None, published: str) -> dict[str, str]:
    """The published row that answers to a line; {} where there is none."""
    for row in reference_rows(name) if match is not None else ():
        if row["dataset"] == published and all(row[key] == value for key, value in (match or {}).items()):
            return row
    return {}
