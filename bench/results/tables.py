"""The tables of a run store (:mod:`.reports.schema`), derived from its records and from nothing else.

Each kind of jobs makes its own rows (:meth:`.bench.store.records.Job.rows`); here they are joined with what
all rows share, and what is not compared is marked.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterable, Mapping
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.method import TrainingJob
from econgs_bench.bench.jobs.truth import FILES, renderer_of
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.results import identity
from econgs_bench.bench.results.rungs import ladders_of, rungs_of
from econgs_bench.bench.results.versions import changes, elected, scene_choices
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Job, Record, Row
from econgs_bench.bench.store.store import Store, aside_of
from econgs_bench.bench.suites.ladders import Ladder
from econgs_bench.datasets.catalogue.entries import built_in, entry, is_procedural, members
from econgs_bench.reports import comparability
from econgs_bench.reports.schema import TABLES, frame, joined

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.methods.interface import MethodSpec

_ORDER = ("dataset", "kind", "scene", "method", "variant", "preset", "seed", "rate", "split")


def build_tables(
    store: Store, methods: Mapping[str, MethodSpec] | None = None, *, write: bool = True
) -> dict[str, pd.DataFrame]:
    """Derive all tables of a store, and write them as Parquet (each file whole or as before).

    Where the store holds several results for one cell, one is elected
    (:func:`.bench.results.versions.elected`); the others are rows of the table `superseded` alone.

    Args:
        store: where the records are.
        methods: name -> spec of today; rows that it would not make are stale
            (:func:`.bench.results.versions.changes`).
        write: whether to write files, if the store can be written.

    Returns:
        The tables as readers get them (:func:`.reports.schema.joined`).
    """
    lineage = Lineage(store.records())
    tables = _compared(lineage, methods or {}, ladders_of(store.root))
    if write and os.access(store.tables, os.W_OK):
        with store.lease("tables"):
            for leftover in store.tables.glob(".*"):  # of a process that was killed
                leftover.unlink(missing_ok=True)
            for name, table in tables.items():
                target = store.tables / f"{name}.parquet"
                with aside_of(target) as aside:
                    table.to_parquet(aside, index=False)
                    os.replace(aside, target)
    return joined(tables)


def derived(
    lineage: Lineage, methods: Mapping[str, MethodSpec] | None = None, ladders: Collection[Ladder] = ()
) -> dict[str, pd.DataFrame]:
    """The tables of records, as :func:`build_tables` returns those of a store.

    Args:
        lineage: the records.
        methods: name -> spec of today.
        ladders: of the suites that were run.
    """
    return joined(_compared(lineage, methods or {}, ladders))


def _compared(
    lineage: Lineage, methods: Mapping[str, MethodSpec], ladders: Collection[Ladder]
) -> dict[str, pd.DataFrame]:
    """As on disk: datasets by what they show, and of each row what is not compared."""
    names = {record.job.id for record in elected(lineage, methods)}
    tables = _stored(lineage, methods, names, ladders)
    before = tables["jobs"]
    jobs = tables["jobs"] = comparability.set_apart(before, _today(lineage))
    tables = _rivals_together(tables, before["dataset"])
    full = joined({name: tables[name] for name in ("jobs", "results", "superseded")})
    results = comparability.judged(full["results"])
    reasons = dict(zip(results["job"], results["differences"], strict=True))
    texts = [reasons.get(job, text) for job, text in zip(jobs["job"], jobs["differences"], strict=True)]
    tables["jobs"] = jobs.assign(differences=texts).astype({"differences": jobs["differences"].dtype})
    listed = comparability.listing(results, full["superseded"])
    tables["differences"] = frame("differences", listed.to_dict("records"), stored=True)  # type: ignore[arg-type]
    return tables


def _rivals_together(tables: dict[str, pd.DataFrame], before: pd.Series) -> dict[str, pd.DataFrame]:
    """Tables whose rows of one version of a dataset follow each other, and whose ladders are climbed on one.

    Args:
        tables: as on disk, with the versions in the table `jobs`.
        before: the datasets of its rows before they were told apart.
    """
    jobs = tables["jobs"]
    if before.equals(jobs["dataset"]):
        return tables
    rungs, versions = tables["rungs"], dict(zip(jobs["job"], jobs["dataset"], strict=True))
    words = {
        job: version.removeprefix(name) for (job, version), name in zip(versions.items(), before, strict=True)
    }
    subjects = [
        f"{versions[job]}/{subject.rpartition('/')[2]}"
        if words[job] and subject
        else subject or words[job].strip(", ")
        for job, subject in zip(rungs["job"], rungs["subject"].fillna(""), strict=True)
    ]
    tables = tables | {"rungs": rungs.assign(subject=subjects).astype(rungs.dtypes)}
    places = {version: place for place, version in enumerate(dict.fromkeys(jobs["dataset"]))}
    order = {job: places[version] for job, version in versions.items()}

    def sorted_by(table: pd.DataFrame, column: str, places: Mapping[Any, int]) -> pd.DataFrame:
        return table.sort_values(column, key=lambda own: own.map(places), kind="stable", ignore_index=True)

    together = {name: sorted_by(table, "job", order) for name, table in tables.items() if "job" in table}
    ladders = {name: place for place, name in enumerate(dict.fromkeys(rungs["ladder"]))}
    return tables | together | {"rungs": sorted_by(together["rungs"], "ladder", ladders)}


def _today(lineage: Lineage) -> comparability.Current:
    """Contents that scenes have today, in the catalogue or on disk; data are opened once, when asked for."""
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.content import content
    from econgs_bench.datasets.errors import DataError

    opened = cache(open_dataset)

    def current(name: str, scene: str) -> list[str]:
        sources = {one.job.dataset for one in lineage if one.job.dataset_name == name}
        found = []
        for source in sorted(sources):
            try:
                dataset = opened(source)
                parts = [part.name for part in dataset.parts(scene)]
                found.append(content(dataset, parts, composed=scene in dataset.compositions))
            except (DataError, OSError):  # it is gone, or has no such scene
                continue
        return found

    return current


def stored_tables(
    records: Iterable[Record],
    methods: Mapping[str, MethodSpec] | None = None,
    ladders: Iterable[Ladder] = (),
) -> dict[str, pd.DataFrame]:
    """All tables of all records as they are on disk: axes in `jobs` alone.

    Args:
        records: of one store, or of several joined.
        methods: name -> spec of today.
        ladders: of the suites that were run.
    """
    lineage = Lineage(records)
    return _stored(lineage, methods or {}, lineage.by_id.keys(), list(ladders))


def rungs_table(records: Iterable[Record], ladders: Iterable[Ladder]) -> pd.DataFrame:
    """The table `rungs` of measurements, as readers get it.

    Args:
        records: of measurements.
        ladders: of a suite.
    """
    return joined(stored_tables(records, ladders=ladders))["rungs"]


def _stored(
    lineage: Lineage,
    methods: Mapping[str, MethodSpec],
    newest: Collection[str],
    ladders: Collection[Ladder],
) -> dict[str, pd.DataFrame]:
    tables: dict[str, list[Row]] = {name: [] for name in TABLES}
    axes = {}
    choices, marks = scene_choices(lineage), identity.disagreeing(lineage)
    mended = _mended(lineage) - set(newest) | _mended(lineage.by_id[name] for name in newest)
    for name, record in lineage.by_id.items():
        axes[name] = _axes(record, lineage, choices) | identity.axes(record, lineage, marks)
        tables["jobs"].append({"job": name, **axes[name]})
        if name in mended:
            continue
        own = _rows(record, lineage, methods)
        if name in newest:
            rungs = list(rungs_of(record.job, ladders))
            if not record.job.stress:
                for table, rows in own.items():
                    tables[table] += ({"job": name, **row} for row in rows)
            if rungs:
                failed = None if record.ok else (record.cause or record.job.id).partition("-")[0]
                facts = {"job": name, **own["results"][0], "failed_step": failed}
                tables["rungs"] += (facts | rung for rung in rungs)
                tables["rung_views"] += ({"job": name, **row} for row in own.get("views", ()))
        elif not record.job.stress:
            tables["superseded"] += ({"job": name, **row} for row in own.get("results", ()))
    for table, rows in tables.items():
        keys = [key for key in _ORDER if key not in ("kind", "split") or key in TABLES[table].columns]
        rows.sort(key=partial(_order, keys, axes))
    places = {ladder.name: place for place, ladder in enumerate(ladders)}
    tables["rungs"].sort(key=lambda row: places[row["ladder"]])
    return {table: frame(table, rows, stored=True) for table, rows in tables.items()}


def _rows(record: Record, lineage: Lineage, methods: Mapping[str, MethodSpec]) -> dict[str, list[Row]]:
    """Table -> the rows of a job; a result says whether its fits would be others today."""
    tables = {table: list(rows) for table, rows in record.job.rows(record, lineage).items()}
    if results := tables.get("results"):
        changed = changes(lineage.fits(record), methods)
        tables["results"] = [row | {"stale": bool(changed), "changes": changed} for row in results]
    return tables


# --------------------------------------------------------------------------- axes of a job


def _axes(record: Record, lineage: Lineage, choices: Mapping[str, int]) -> Row:
    job, fits = record.job, lineage.fits(record)
    made = next((fit.job for fit in fits), job)
    fit = next((one for one in (fit.of(FitResult) for fit in fits) if one is not None), None)
    where = record.provenance or next((fit.provenance for fit in fits), None)
    fitted = [scene for fit in fits for scene in fit.job.scenes]
    return job.axes() | {
        "procedural": is_procedural(job.dataset),
        "fitted_scenes": json.dumps(fitted) if fitted else None,
        "scenes_together": choices.get(job.id),
        "method_version": made.method_version if isinstance(made, TrainingJob) else None,
        "train_views": fit.train_views if fit else None,
        "samples": _samples(record, lineage),
        "machine": where.machine if where else None,
        "processor": _processors([record]) if record.ok else None,
        "fit_processor": _processors(fits),
        "threads": where.threads if where else None,
        "finished": record.finished,
        "commit": where.commit if where else None,
        "source": next((fit.provenance.source for fit in fits if fit.provenance), None),
    }


def _samples(record: Record, lineage: Lineage) -> int | None:
    """Rays a pixel of the views; None for pre-rendered ones, and where that is not known."""
    if record.job.request.samples != 1:
        return record.job.request.samples
    if (views := record.of(ViewsResult)) is not None:
        known: str | None = renderer_of(views.cost.get(record.job.split))
    else:
        renderers = (identity.renderer(one, lineage) for one in (record, *lineage.fits(record)))
        known = next(filter(None, renderers), None)
    here = known != FILES if known else _has_volume(record.job.dataset)
    return 1 if here else None


@cache
def _has_volume(dataset: str) -> bool:
    """Whether the catalogue renders all parts of a dataset here, for records without their views."""
    return all(part in built_in() and entry(part)["kind"] != "views" for part in members(dataset))


def _processors(records: list[Record]) -> str | None:
    """As "AMD EPYC, 2 cores, avx2": host names mean nothing where machines come and go.

    A job that could not use all cores had neighbours: it is told by "1 of 2 cores".
    """
    names = []
    for where in (record.provenance for record in records):
        if where is not None:
            part = where.usable is not None and where.usable < where.cores
            cores = f"{where.usable} of {where.cores} cores" if part else f"{where.cores} cores"
            names.append(", ".join(filter(None, [where.gpu or where.cpu, cores, where.isa])))
    return "; ".join(dict.fromkeys(names)) or None


# --------------------------------------------------------------------------- mended jobs and order


def _mended(records: Iterable[Record]) -> set[str]:
    """Failed jobs that another job succeeded in: a new partition gives the next ones other identities."""
    records = list(records)
    failed = [record.job for record in records if not record.ok]
    kinds = {job.kind for job in failed}
    answered = {_question(record.job) for record in records if record.ok and record.job.kind in kinds}
    return {job.id for job in failed if _question(job) in answered}


def _question(job: Job) -> str:
    """What a job is to find out, without the group that a partition put its scene into."""
    whole = job.model_dump(exclude={"key", "identity", "needs", "group"})
    return json.dumps(whole, sort_keys=True, default=str)


def _order(keys: Iterable[str], axes: Mapping[str, Row], row: Row) -> list[tuple[Any, ...]]:
    """Rows of one experiment together, whatever their jobs' hashes; the sort keeps the order within a job."""
    own = axes[row["job"]]
    return [_natural(row[key] if key in row else own[key]) for key in keys]


@cache
def _natural(value: Any) -> tuple[Any, ...]:
    """Sorts missing values first, numbers by size, and names as people do: tf2 before tf10."""
    if value is None or isinstance(value, int | float):
        return (value is not None, value or 0)
    parts = re.split(r"(\d+)", value)
    return True, tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts)
