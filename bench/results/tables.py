"""The tables of a run store (:mod:`.reports.schema`), derived from its records and from nothing else."""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache, partial
from typing import TYPE_CHECKING, Any, TypeVar

from econgs_bench.bench.results import identity
from econgs_bench.bench.results.lineage import Lineage, Model
from econgs_bench.bench.results.rungs import ladders_of, rungs_of
from econgs_bench.bench.results.versions import changes, elected, scene_choices
from econgs_bench.bench.store.records import EncodeResult, FitResult, Job, MeasureResult, Record, ViewsResult
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.ladders import Ladder
from econgs_bench.datasets.catalogue.entries import built_in, entry, is_procedural
from econgs_bench.methods.options import label
from econgs_bench.reports import comparability
from econgs_bench.reports.schema import COVERAGE, METRICS, TABLES, frame, joined

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.methods.interface import MethodSpec

Row = dict[str, Any]
_N = TypeVar("_N", int, float)
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
                aside = target.with_name(f".{name}.{uuid.uuid4().hex}")
                try:
                    table.to_parquet(aside, index=False)
                    os.replace(aside, target)
                finally:
                    aside.unlink(missing_ok=True)
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
    jobs = tables["jobs"] = comparability.set_apart(tables["jobs"], _today(lineage))
    full = joined({name: tables[name] for name in ("jobs", "results", "superseded")})
    results = comparability.judged(full["results"])
    reasons = dict(zip(results["job"], results["differences"], strict=True))
    texts = [reasons.get(job, text) for job, text in zip(jobs["job"], jobs["differences"], strict=True)]
    tables["jobs"] = jobs.assign(differences=texts).astype({"differences": jobs["differences"].dtype})
    listed = comparability.listing(results, full["superseded"])
    tables["differences"] = frame("differences", listed.to_dict("records"), stored=True)  # type: ignore[arg-type]
    return tables


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
        if name in newest:
            if not record.job.stress:
                for table, facts in _facts(record, lineage, methods).items():
                    tables[table] += ({"job": name, **row} for row in facts)
            rungs = list(_rungs(record, lineage, methods, ladders))
            tables["rungs"] += ({"job": name, **row} for row in rungs)
            if rungs:
                views = _views(record, lineage.needed(record, "views"))
                tables["rung_views"] += ({"job": name, **row} for row in views)
        elif record.job.kind == "measure" and not record.job.stress:
            tables["superseded"].append({"job": name, **_result(record, lineage, methods)})
    for table, rows in tables.items():
        keys = [key for key in _ORDER if key not in ("kind", "split") or key in TABLES[table].columns]
        rows.sort(key=partial(_order, keys, axes))
    places = {ladder.name: place for place, ladder in enumerate(ladders)}
    tables["rungs"].sort(key=lambda row: places[row["ladder"]])
    return {table: frame(table, rows, stored=True) for table, rows in tables.items()}


def share(total: int, names: Iterable[str], name: str) -> int:
    """The part of ``total`` that falls to one of several; the parts sum to it exactly."""
    order = list(names)
    base, rest = divmod(total, len(order))
    return base + (1 if order.index(name) < rest else 0)


# --------------------------------------------------------------------------- axes of a job


def _axes(record: Record, lineage: Lineage, choices: Mapping[str, int]) -> Row:
    job, fits = record.job, lineage.fits(record)
    made = next((fit.job.identity for fit in fits), job.identity)
    fit = next((fit.fit for fit in fits if fit.fit is not None), None)
    where = record.provenance or next((fit.provenance for fit in fits), None)
    fitted = [scene for fit in fits for scene in fit.job.scenes]
    return {
        "step": job.kind,
        "dataset": job.dataset_name,
        "procedural": is_procedural(job.dataset),
        "scene": f"{job.subject} {job.edit}".strip(),
        "kind": "edited" if job.edit else "composed" if job.composition else "basic",
        "edit": job.edit,
        "stress": job.stress,
        "members": json.dumps(job.scenes),
        "group": job.group,
        "fitted_scenes": json.dumps(fitted) if fitted else None,
        "scenes_together": choices.get(job.id),
        "method": job.method,
        "method_version": made["method"][1] if "method" in made else None,
        "variant": job.variant,
        "base": label({name: value for name, value in job.overrides.items() if name != job.knob}),
        "options": json.dumps(job.overrides) if job.method else None,
        "knob": job.knob or None,
        "knob_value": job.overrides.get(job.knob),
        "rate": job.rate,
        "preset": job.preset,
        "split": job.split,
        "seed": job.seed,
        "requested_views": job.request.train_views,
        "train_views": fit.train_views if fit else None,
        "iterations": job.iterations,
        "width": job.request.width,
        "height": job.request.height,
        "samples": _samples(record, lineage),
        "device": job.device,
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
    if record.views is not None:
        known: str | None = identity.renderer_of(record.views.cost.get(record.job.split))
    else:
        renderers = (identity.renderer(one, lineage) for one in (record, *lineage.fits(record)))
        known = next(filter(None, renderers), None)
    here = known != identity.FILES if known else _has_volume(record.job.dataset)
    return 1 if here else None


@cache
def _has_volume(dataset: str) -> bool:
    """Whether the catalogue renders all parts of a dataset here, for records without their views."""
    parts = [part.partition("@")[0] for part in dataset.split("+")]
    return all(part in built_in() and entry(part)["kind"] != "views" for part in parts)


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


# --------------------------------------------------------------------------- facts of a job


def _facts(record: Record, lineage: Lineage, methods: Mapping[str, MethodSpec]) -> dict[str, Iterable[Row]]:
    """Table -> the rows of a job, without the job."""
    return {
        "results": [_result(record, lineage, methods)] if record.job.kind == "measure" else [],
        "views": _views(record, lineage.needed(record, "views")),
        "curve": _curve(record),
        "losses": _losses(record),
        "ledger": _ledger(record),
        "timing": _timing(record),
        "features": _features(record),
        "scenes": _scenes(record),
        "floors": _floors(record),
        "dvr": [_dvr(record)] if record.job.kind == "dvr" else [],
        "complexity": [record.complexity.model_dump()] if record.complexity is not None else [],
    }


def _views(record: Record, truth: list[Record]) -> Iterator[Row]:
    background = next((_hex(job.views.background) for job in truth if job.views is not None), None)
    views = record.measure.views if record.measure else []
    for name, view in zip(_distinct([view.view for view in views]), views, strict=True):
        metrics = {metric: view.metrics.get(metric) for metric in (*METRICS, *COVERAGE)}
        yield view.model_dump() | {"view": name} | metrics | {"background": background}


def _distinct(names: list[str]) -> list[str]:
    """Names that tell the views of a job apart, as every reader of the tables takes them to.

    Records of version 0.2 and before have the same for pictures of the same file name in two folders.
    """
    if len(set(names)) == len(names):
        return names
    return [f"{name} ({names[:place].count(name) + 1})" for place, name in enumerate(names)]


def _curve(record: Record) -> Iterator[Row]:
    for scene in record.job.scenes:
        for point in record.fit.curve if record.fit else ():
            own = {"scene": scene, "psnr": point.psnr.get(scene), "loss_parts": json.dumps(point.loss_parts)}
            yield point.model_dump() | own


def _losses(record: Record) -> Iterator[Row]:
    for stretch in record.fit.losses if record.fit else ():
        yield stretch.model_dump() | {"losses": json.dumps(stretch.losses)}


def _ledger(record: Record) -> Iterator[Row]:
    for scene, parts in record.encode.ledger.items() if record.encode else ():
        for part, count in parts.items():
            yield {"scene": scene, "part": part, "bytes": count}


def _timing(record: Record) -> Iterator[Row]:
    """Nothing for an edited scene, which is of the same model."""
    parts = record.measure.timing if record.measure and not record.job.edit else {}
    for part, seconds in parts.items():
        yield {"part": part, "seconds": seconds}


def _features(record: Record) -> Iterator[Row]:
    """Nothing for an edited scene, which is of the same model."""
    features = record.measure.features if record.measure and not record.job.edit else {}
    for name, rows in features.items():
        if rows:
            values = [value for row in rows for value in row]
            yield {"name": name, "values": values, "width": len(rows[0])}


def _scenes(record: Record) -> Iterator[Row]:
    if record.views is not None and record.views.transfer:
        yield {
            "transfer": json.dumps(record.views.transfer, separators=(",", ":")),
            "variable": record.views.variable or None,
            "cloud_seconds": record.views.cloud_seconds,
        }


def _floors(record: Record) -> Iterator[Row]:
    for name, reached in _reached(record.views).items():
        yield {"picture": name, **reached}


def _reached(views: ViewsResult | None) -> dict[str, Mapping[str, float | None]]:
    """Picture -> metric -> what it reaches against truth of other rays; empty where that is not known."""
    if views is None or not views.floor:
        return {}
    return {"truth": views.floor, "one ray": views.one_ray}


def _rungs(
    record: Record, lineage: Lineage, methods: Mapping[str, MethodSpec], ladders: Iterable[Ladder]
) -> Iterator[Row]:
    """A row per ladder of which the measurement is a rung."""
    rungs = list(rungs_of(record.job, ladders))
    facts = _result(record, lineage, methods) if rungs else {}
    failed = None if record.ok else (record.cause or record.job.id).partition("-")[0]
    for rung in rungs:
        yield facts | rung | {"failed_step": failed}


def _result(record: Record, lineage: Lineage, methods: Mapping[str, MethodSpec]) -> Row:
    """The row of a basic scene (with one model) or of a composition (with those that hold its scenes)."""
    models, fits = lineage.models(record), lineage.fits(record)
    changed = changes(fits, methods)
    truth = next((one.views for one in lineage.needed(record, "views") if one.views is not None), None)
    reached = _reached(truth)
    row = {
        "status": record.status,
        "reason": record.reason,
        "stage": record.stage,
        "stale": bool(changed),
        "changes": changed,
        "recipe": json.dumps(record.job.recipe) if record.job.recipe else "",
        "distance": truth.distance if truth is not None else None,
        "floor": reached.get("truth", {}).get("psnr"),
        "one_ray": reached.get("one ray", {}).get("psnr"),
        "fit_reference_seconds": _largest(fit.fit.reference_seconds for fit in fits if fit.fit is not None),
        "fit_reference_worst": _largest(fit.fit.reference_worst for fit in fits if fit.fit is not None),
        **_costs(record.job, models),
        **_memory(record, fits),
        "start_points": _start_points(record.job, fits),
        "render_host_bytes": record.peak_host_bytes,
        "render_device_bytes": record.peak_device_bytes,
    }
    return row | (_measured(record.measure) if record.measure is not None else {})


def _measured(measured: MeasureResult) -> Row:
    row: Row = {name: measured.metrics.get(name) for name in (*METRICS, *COVERAGE)}
    if measured.missing:
        row["reason"] = "; ".join(f"{name}: {why}" for name, why in sorted(measured.missing.items()))
        row["omissions"] = json.dumps(measured.missing, sort_keys=True)
    return row | {
        "primitives": measured.primitives,
        "load_seconds": measured.load_seconds,
        "fps": 1.0 / measured.frame_seconds,
        "fps_p05": 1.0 / measured.frame_seconds_p95,
        "fps_p95": 1.0 / measured.frame_seconds_p05,
        "decoding": measured.decoding,
        "fps_decoding": measured.frame_seconds_decoding and 1.0 / measured.frame_seconds_decoding,
        "ruler": measured.ruler,
        "parts_ruler": measured.parts_ruler,
        "reference_seconds": measured.reference_seconds,
        "reference_worst": measured.reference_worst,
        "identical_views": sum(view.identical for view in measured.views),
        "flicker": measured.flicker,
        "drawn": measured.drawn,
        **({"gaussians": measured.pruning.gaussians, **measured.pruning.shares} if measured.pruning else {}),
    }


def _start_points(job: Job, fits: list[Record]) -> int | None:
    """Points of the initial clouds of a job's scenes."""
    counts = {name: count for one in fits if one.fit for name, count in one.fit.cloud_points.items()}
    return sum(counts[scene] for scene in job.rendered) if counts.keys() >= set(job.rendered) else None


def _memory(record: Record, fits: list[Record]) -> Row:
    return {
        "peak_host_bytes": _largest(one.peak_host_bytes for one in (record, *fits)),
        "peak_device_bytes": _largest(one.peak_device_bytes for one in (record, *fits)),
        "group_peak_host_bytes": _largest(fit.peak_host_bytes for fit in fits),
    }


def _largest(values: Iterable[_N | None]) -> _N | None:
    return max((value for value in values if value is not None), default=None)


def _costs(job: Job, models: list[Model]) -> Row:
    """Bytes and seconds of all models together; what any model lacks, their sum lacks."""
    costs = [_cost(job, model) for model in models]
    names = set(costs[0]).intersection(*costs[1:]) if costs else ()
    partitions = {model.partition.job.id: model.partition.partition for model in models if model.partition}
    seconds = [result.seconds for result in partitions.values() if result is not None]
    return {name: sum(cost[name] for cost in costs) for name in names} | {
        "partition_seconds": sum(seconds) if seconds else None
    }


def _cost(job: Job, model: Model) -> dict[str, float]:
    """Bytes and seconds of those scenes of a job that one model holds."""
    if model.encode is None or model.encode.encode is None:
        return {}
    encode, group = model.encode.encode, model.encode.job.scenes
    scenes = [scene for scene in job.rendered if scene in group]
    cost: dict[str, float] = {"encode_seconds": encode.seconds, **_sizes(scenes, group, encode)}
    if model.fit is not None and model.fit.fit is not None:
        cost |= _times(len(scenes), len(group), encode, model.fit.fit, model.partition)
    return cost


def _sizes(scenes: list[str], group: tuple[str, ...], encode: EncodeResult) -> dict[str, int]:
    """Own part + share of the shared part; they sum to the group's bytes over its scenes."""
    own = sum(sum(encode.ledger.get(scene, {}).values()) for scene in scenes)
    shared = sum(encode.ledger.get("", {}).values())
    return {
        "size_bytes": own + sum(share(shared, group, scene) for scene in scenes),
        "group_bytes": encode.total_bytes,
        "standalone_bytes": own + shared,
    }


def _times(
    scenes: int, group: int, encode: EncodeResult, fit: FitResult, partition: Record | None
) -> dict[str, float]:
    """Partition + fit + encode; partition time is shared by all scenes of the dataset."""
    seconds = fit.seconds + encode.seconds
    if partition is not None and partition.partition is not None:
        seconds += partition.partition.seconds * group / len(partition.job.scenes)
    times = {"group_seconds": seconds, "train_seconds": seconds * scenes / group}
    if fit.cpu_seconds is not None:  # older records have none
        times["cpu_seconds"] = fit.cpu_seconds * scenes / group
    return times


def _dvr(record: Record) -> Row:
    row: Row = {"status": record.status, "reason": record.reason, **_memory(record, [])}
    cost = record.dvr
    if cost is None:
        return row
    same = ("dtype", "volume_bytes", "load_seconds", "setup_seconds", "renderer", "version", "backend",
            "reference_seconds")  # fmt: skip
    return (
        row
        | dict(zip(("nx", "ny", "nz"), cost.dims, strict=True))
        | {name: getattr(cost, name) for name in same}
        | {
            "variables": ";".join(cost.variables),
            "ms_per_view": 1e3 * cost.frame_seconds,
            "ms_p05": 1e3 * cost.frame_seconds_p05,
            "ms_p95": 1e3 * cost.frame_seconds_p95,
            "fps": 1.0 / cost.frame_seconds,
        }
    )


def _hex(color: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02x}" for value in color)


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
