"""The documented tables (:mod:`reports.schema`), derived from the records and from nothing else."""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bench.records import CurvePoint, EncodeResult, FitResult, Job, Record
from bench.store import Store
from bench.versions import is_stale, standing
from reports.schema import COVERAGE, METRICS, TABLES, frame

if TYPE_CHECKING:
    import pandas as pd


def share(total: int, names: Iterable[str], name: str) -> int:
    """The part of ``total`` that falls to one of several; the parts sum to it exactly."""
    order = list(names)
    base, rest = divmod(total, len(order))
    return base + (1 if order.index(name) < rest else 0)


def rows(
    records: Iterable[Record], sources: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[dict[str, Any]]]:
    """All tables as lists of rows.

    Args:
        records: of one store, or of several joined.
        sources: method -> hashes of its source now; where a fit's is none of them, its rows are stale.
    """
    by_id = {record.job.id: record for record in records}
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    answered = {_question(record.job) for record in by_id.values() if record.ok}
    for record in by_id.values():
        job = record.job
        if not record.ok and _question(job) in answered:
            continue  # mended: the job of a failed partition has another identity than those of the next one
        if job.kind == "measure":
            models = [_Fitted.of(by_id, encode) for encode in _all_needed(by_id, record, "encode")]
            tables["results"].append(_result(record, models, sources or {}))
            tables["views"] += _views(record, _needed(by_id, record, "views"))
            if not job.edit:  # of the same model
                tables["timing"] += _timing(record)
                tables["features"] += _features(record)
        elif job.kind == "views" and record.views is not None and record.views.transfer:
            said = json.dumps(record.views.transfer, separators=(",", ":"))
            tables["scenes"].append({"job": job.id, **_axes(job), "split": job.split, "transfer": said})
        elif job.kind == "dvr":
            tables["dvr"].append(_dvr(record))
        elif job.kind == "fit" and record.fit is not None:
            tables["curve"] += [
                {"job": job.id, **_axes(job), **_point(point, scene)}
                for scene in job.scenes
                for point in record.fit.curve
            ]
            tables["losses"] += [
                {"job": job.id, **_axes(job), **point.model_dump(), "losses": json.dumps(point.losses)}
                for point in record.fit.losses
            ]
        elif job.kind == "encode" and record.encode is not None:
            tables["ledger"] += [
                {"job": job.id, **_axes(job), "scene": scene, "part": part, "bytes": count}
                for scene, parts in record.encode.ledger.items()
                for part, count in parts.items()
            ]
    for table in tables.values():
        table.sort(key=_order)
    return tables


def _point(point: CurvePoint, scene: str) -> dict[str, Any]:
    changed = {"scene": scene, "psnr": point.psnr.get(scene), "loss_parts": json.dumps(point.loss_parts)}
    return point.model_dump() | changed


def build_tables(
    store: Store, sources: Mapping[str, Sequence[str]] | None = None, *, write: bool = True
) -> dict[str, pd.DataFrame]:
    """Derive all tables of a store, and write them as Parquet (each file whole or as before).

    Where the store holds several versions of a model, one is in them (:func:`bench.versions.standing`);
    the rows of the others are in the table ``superseded`` alone.
    """
    records = list(store.records())
    shown = standing(records, sources or {})
    tables = rows(shown, sources)
    if len(shown) < len(records):
        kept = {record.job.id for record in shown}
        tables["superseded"] = [row for row in rows(records, sources)["results"] if row["job"] not in kept]
    frames = {name: frame(name, table) for name, table in tables.items()}
    if write:
        with store.lock("tables"):
            for name, table in frames.items():
                target = store.tables / f"{name}.parquet"
                aside = target.with_name(f".{name}.{uuid.uuid4().hex}")
                table.to_parquet(aside, index=False)
                os.replace(aside, target)
    return frames


# --------------------------------------------------------------------------- one record's rows


@dataclass(frozen=True)
class _Fitted:
    """A saved model's records: of its encode job and of those it came from (where the store has them)."""

    encode: Record
    fit: Record | None
    partition: Record | None

    @classmethod
    def of(cls, by_id: Mapping[str, Record], encode: Record) -> _Fitted:
        fit = _needed(by_id, encode, "fit")
        return cls(encode, fit, _needed(by_id, fit, "partition"))


def _result(record: Record, models: list[_Fitted], sources: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The row of a basic scene (with one model) or of a composition (with those that hold its scenes)."""
    job, measured = record.job, record.measure
    fits = [model.fit for model in models if model.fit is not None]
    where = record.provenance or (fits[0].provenance if fits else None)
    trained = fits[0].fit if fits else None
    row: dict[str, Any] = {
        **_axes(job),
        "kind": "composed" if job.composition else "edited" if job.edit else "basic",
        "split": job.split,
        "status": record.status,
        "reason": record.reason,
        "stale": any(is_stale(job, fit, sources) for fit in fits),
        "group": job.group,
        "iterations": job.iterations,
        "width": job.request.width,
        "height": job.request.height,
        "device": job.device,
        "machine": where.machine if where else None,
        "threads": where.threads if where else None,
        "commit": where.commit if where else None,
        "source": next((fit.provenance.source for fit in fits if fit.provenance), None),
        "job": job.id,
        "edit": job.edit,
        "stage": record.stage,
        "train_views": trained.train_views if trained else None,
        "processor": _processors([record]) if measured is not None else None,
        "fit_processor": _processors(fits),
    }
    partitions = {model.partition.job.id: model.partition for model in models if model.partition}
    clustered = [one.partition.seconds for one in partitions.values() if one.partition is not None]
    row["partition_seconds"] = sum(clustered) if clustered else None
    costs = [_costs(job, model) for model in models]
    if costs:
        # What any model lacks, their sum lacks.
        names = set(costs[0]).intersection(*costs[1:])
        row.update({name: sum(cost[name] for cost in costs) for name in names})
    memory = [r.peak_host_bytes for r in (record, *fits) if r.peak_host_bytes is not None]
    device = [r.peak_device_bytes for r in (record, *fits) if r.peak_device_bytes is not None]
    row["peak_host_bytes"] = max(memory, default=None)
    row["peak_device_bytes"] = max(device, default=None)
    row["group_peak_host_bytes"] = max((f.peak_host_bytes for f in fits if f.peak_host_bytes), default=None)
    if measured is not None:
        row.update({name: measured.metrics.get(name) for name in (*METRICS, *COVERAGE)})
        if measured.missing:
            row["reason"] = "; ".join(f"{name}: {why}" for name, why in sorted(measured.missing.items()))
        row.update(
            primitives=measured.primitives,
            load_seconds=measured.load_seconds,
            fps=1.0 / measured.frame_seconds,
            fps_p05=1.0 / measured.frame_seconds_p95,
            fps_p95=1.0 / measured.frame_seconds_p05,
            reference_seconds=measured.reference_seconds,
            identical_views=sum(view.identical for view in measured.views),
        )
    return row


def _processors(records: list[Record]) -> str | None:
    """What jobs ran on: "AMD EPYC, 2 cores, avx2"; host names tell nothing where machines come and go."""
    found = [record.provenance for record in records if record.provenance is not None]
    names = [
        ", ".join([where.gpu or where.cpu, f"{where.cores} cores", *([where.isa] if where.isa else [])])
        for where in found
    ]
    return "; ".join(dict.fromkeys(names)) or None


def _costs(job: Job, model: _Fitted) -> dict[str, float]:
    """Bytes and seconds of those scenes of a job that one model holds."""
    encode, group = model.encode.encode, model.encode.job.scenes
    scenes = [scene for scene in job.scenes if scene in group]
    if encode is None:
        return {}
    costs: dict[str, float] = {"encode_seconds": encode.seconds, **_sizes(scenes, group, encode)}
    if model.fit is not None and model.fit.fit is not None:
        costs |= _times(scenes, group, encode, model.fit.fit, model.partition)
    return costs


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
    scenes: list[str],
    group: tuple[str, ...],
    encode: EncodeResult,
    trained: FitResult,
    partition: Record | None,
) -> dict[str, float]:
    """Partition + fit + encode; partition time is shared by all scenes of the dataset."""
    seconds = trained.seconds + encode.seconds
    if partition is not None and partition.partition is not None:
        seconds += partition.partition.seconds * len(group) / len(partition.job.scenes)
    times = {"group_seconds": seconds, "train_seconds": seconds * len(scenes) / len(group)}
    if trained.cpu_seconds is not None:  # older records have none
        times["cpu_seconds"] = trained.cpu_seconds * len(scenes) / len(group)
    return times


def _views(record: Record, shown: Record | None) -> list[dict[str, Any]]:
    if record.measure is None:
        return []
    background = _hex(shown.views.background) if shown is not None and shown.views is not None else None
    return [
        {
            "job": record.job.id,
            **_axes(record.job),
            "split": record.job.split,
            "view": view.view,
            **{name: view.metrics.get(name) for name in (*METRICS, *COVERAGE)},
            "identical": view.identical,
            "truth_file": view.truth_file,
            "render_file": view.render_file,
            "background": background,
        }
        for view in record.measure.views
    ]


def _hex(color: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02x}" for value in color)


def _dvr(record: Record) -> dict[str, Any]:
    job, cost, where = record.job, record.dvr, record.provenance
    row: dict[str, Any] = {
        "job": job.id,
        "dataset": job.dataset_name,
        "scene": job.shows,
        "kind": "composed" if job.composition else "basic",
        "preset": job.preset,
        "status": record.status,
        "reason": record.reason,
        "width": job.request.width,
        "height": job.request.height,
        "machine": where.machine if where else None,
        "threads": where.threads if where else None,
        "commit": where.commit if where else None,
        "peak_host_bytes": record.peak_host_bytes,
        "peak_device_bytes": record.peak_device_bytes,
    }
    if cost is not None:
        row |= dict(zip(("nx", "ny", "nz"), cost.dims, strict=True))
        row |= {
            "variables": ";".join(cost.variables),
            "ms_per_view": 1e3 * cost.frame_seconds,
            "ms_p05": 1e3 * cost.frame_seconds_p05,
            "ms_p95": 1e3 * cost.frame_seconds_p95,
            "fps": 1.0 / cost.frame_seconds,
        }
        same = ("dtype", "volume_bytes", "load_seconds", "setup_seconds", "renderer", "version", "backend")
        row |= {name: getattr(cost, name) for name in (*same, "reference_seconds")}
    return row


def _timing(record: Record) -> list[dict[str, Any]]:
    parts = record.measure.timing if record.measure else {}
    return [
        {"job": record.job.id, **_axes(record.job), "part": part, "seconds": seconds}
        for part, seconds in parts.items()
    ]


def _features(record: Record) -> list[dict[str, Any]]:
    features = record.measure.features if record.measure else {}
    return [
        {
            "job": record.job.id,
            **_axes(record.job),
            "name": name,
            "values": [value for row in values for value in row],
            "width": len(values[0]),
        }
        for name, values in features.items()
        if values
    ]


def _question(job: Job) -> str:
    """What a job is to find out, without the group that a partition put its scene into."""
    whole = job.model_dump(exclude={"key", "identity", "needs", "group"})
    return json.dumps(whole, sort_keys=True, default=str)


def _axes(job: Job) -> dict[str, Any]:
    return {
        "dataset": job.dataset_name,
        "scene": f"{job.shows} {job.edit}".strip(),
        "method": job.method,
        "variant": job.variant,
        "rate": job.rate,
        "preset": job.preset,
        "seed": job.seed,
        "requested_views": job.request.train_views,
    }


def _needed(by_id: Mapping[str, Record], record: Record | None, kind: str) -> Record | None:
    return next(iter(_all_needed(by_id, record, kind)), None)


def _all_needed(by_id: Mapping[str, Record], record: Record | None, kind: str) -> list[Record]:
    """Those jobs of a kind that a job builds on; none if the store lacks any of them."""
    names = [n for n in record.job.needs if n.startswith(f"{kind}-")] if record is not None else []
    return [by_id[name] for name in names] if all(name in by_id for name in names) else []


def _order(row: dict[str, Any]) -> list[tuple[Any, ...]]:
    """Rows of one experiment together, whatever their jobs' hashes; the sort keeps the order within a job."""
    keys = ("dataset", "kind", "scene", "method", "variant", "preset", "seed", "rate", "split")
    return [_natural(row.get(key)) for key in keys]


def _natural(value: Any) -> tuple[Any, ...]:
    """Sorts missing values first, numbers by size, and names as people do: tf2 before tf10."""
    if value is None or isinstance(value, int | float):
        return (value is not None, value or 0)
    parts = re.split(r"(\d+)", value)
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts)
