"""The documented tables (docs/architecture.md), derived from the records and from nothing else."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from bench.records import EncodeResult, FitResult, Job, Record
from bench.store import Store

if TYPE_CHECKING:
    import pandas as pd

METRICS = ("psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv")
_AXES = ("dataset", "scene", "method", "variant")
COLUMNS: dict[str, tuple[str, ...]] = {
    "results": (
        "dataset", "scene", "kind", "method", "variant", "rate", "preset", "split", "seed", "status",
        "reason", "stale", "group", *METRICS, "size_bytes", "group_bytes", "standalone_bytes", "primitives",
        "train_seconds", "group_seconds", "load_seconds", "fps", "peak_host_bytes", "peak_device_bytes",
        "iterations", "train_views", "width", "height", "device", "machine", "threads", "job", "fps_p05",
        "fps_p95", "encode_seconds", "reference_seconds", "identical_views", "stage", "commit",
        "group_peak_host_bytes",
    ),
    "views": ("job", *_AXES, "rate", "preset", "split", "seed", "view", *METRICS, "identical", "truth_file",
              "render_file", "alpha_file"),
    "curve": ("job", *_AXES, "preset", "seed", "iteration", "train_seconds", "loss", "psnr_val", "primitives",
              "bytes_estimate"),
    "ledger": ("job", *_AXES, "rate", "preset", "seed", "part", "bytes"),
    "timing": ("job", *_AXES, "rate", "preset", "seed", "part", "seconds"),
    "features": ("job", *_AXES, "name", "values"),
}  # fmt: skip
_TEXT = {
    "dataset", "scene", "kind", "method", "variant", "preset", "split", "status", "reason", "group", "device",
    "machine", "job", "stage", "commit", "view", "truth_file", "render_file", "alpha_file", "part", "name",
}  # fmt: skip
_WHOLE = {
    "seed", "size_bytes", "group_bytes", "standalone_bytes", "primitives", "peak_host_bytes",
    "peak_device_bytes", "iterations", "train_views", "width", "height", "threads", "identical_views",
    "group_peak_host_bytes", "iteration", "bytes_estimate", "bytes",
}  # fmt: skip
_FLAGS = {"stale", "identical"}


def share(total: int, names: Iterable[str], name: str) -> int:
    """The part of ``total`` that falls to one of several; the parts sum to it exactly."""
    order = list(names)
    base, rest = divmod(total, len(order))
    return base + (1 if order.index(name) < rest else 0)


def rows(
    records: Iterable[Record], sources: Mapping[str, str] | None = None
) -> dict[str, list[dict[str, Any]]]:
    """All tables as lists of rows.

    Args:
        records: of one store, or of several joined.
        sources: method -> hash of its source now; where it differs from a fit's, its rows are stale.
    """
    by_id = {record.job.id: record for record in records}
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in COLUMNS}
    for record in by_id.values():
        job = record.job
        if job.kind == "measure":
            encode = _needed(by_id, record, "encode")
            fit = _needed(by_id, encode, "fit")
            partition = _needed(by_id, fit, "partition")
            tables["results"].append(_result(record, encode, fit, partition, sources or {}))
            tables["views"] += _views(record)
            tables["timing"] += _timing(record)
            tables["features"] += _features(record)
        elif job.kind == "fit" and record.fit is not None:
            tables["curve"] += [
                {"job": job.id, **_axes(job), **point.model_dump(), "scene": scene}
                for scene in job.scenes
                for point in record.fit.curve
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


def build_tables(
    store: Store, sources: Mapping[str, str] | None = None, *, write: bool = True
) -> dict[str, pd.DataFrame]:
    """Derive all tables of a store, and write them as Parquet (each file whole or as before)."""
    frames = {name: frame(name, table) for name, table in rows(store.records(), sources).items()}
    if write:
        with store.lock("tables"):
            for name, table in frames.items():
                target = store.tables / f"{name}.parquet"
                aside = target.with_name(f".{name}.{uuid.uuid4().hex}")
                table.to_parquet(aside, index=False)
                os.replace(aside, target)
    return frames


def frame(name: str, table: list[dict[str, Any]]) -> pd.DataFrame:
    """One table with its documented columns and types (nullable: what is missing is null)."""
    import pandas as pd

    data = {}
    for column in COLUMNS[name]:
        values = [row.get(column) for row in table]
        data[column] = pd.Series(values, dtype=_dtype(column))
    return pd.DataFrame(data, columns=list(COLUMNS[name]))


def _dtype(column: str) -> str:
    if column in _TEXT:
        return "string"
    if column in _WHOLE:
        return "Int64"
    if column in _FLAGS:
        return "boolean"
    return "object" if column == "values" else "Float64"


# --------------------------------------------------------------------------- one record's rows


def _result(
    record: Record,
    encode: Record | None,
    fit: Record | None,
    partition: Record | None,
    sources: Mapping[str, str],
) -> dict[str, Any]:
    job, measured = record.job, record.measure
    where = record.provenance or (fit.provenance if fit else None)
    trained = fit.fit if fit else None
    row: dict[str, Any] = {
        **_axes(job),
        "kind": "basic",
        "split": job.split,
        "status": record.status,
        "reason": record.reason,
        "stale": _stale(job, fit, sources),
        "group": job.group,
        "iterations": job.iterations,
        "width": job.request.width,
        "height": job.request.height,
        "device": job.device,
        "machine": where.machine if where else None,
        "threads": where.threads if where else None,
        "commit": where.commit if where else None,
        "job": job.id,
        "stage": record.stage,
        "train_views": trained.train_views if trained else None,
    }
    if encode is not None and encode.encode is not None:
        row.update(_sizes(job, encode.job.scenes, encode.encode))
        row["encode_seconds"] = encode.encode.seconds
        if fit is not None and trained is not None:
            row.update(_times(encode.job.scenes, encode.encode, trained, partition))
    memory = [r.peak_host_bytes for r in (record, fit) if r is not None and r.peak_host_bytes is not None]
    device = [r.peak_device_bytes for r in (record, fit) if r is not None and r.peak_device_bytes is not None]
    row["peak_host_bytes"] = max(memory, default=None)
    row["peak_device_bytes"] = max(device, default=None)
    row["group_peak_host_bytes"] = fit.peak_host_bytes if fit else None
    if measured is not None:
        row.update({name: measured.metrics.get(name) for name in METRICS})
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


def _sizes(job: Job, group: tuple[str, ...], encode: EncodeResult) -> dict[str, int]:
    """Own part + share of the shared part; they sum to the group's bytes over its scenes."""
    scene = job.scenes[0]
    own = sum(encode.ledger.get(scene, {}).values())
    shared = sum(encode.ledger.get("", {}).values())
    return {
        "size_bytes": own + share(shared, group, scene),
        "group_bytes": encode.total_bytes,
        "standalone_bytes": own + shared,
    }


def _times(
    group: tuple[str, ...], encode: EncodeResult, trained: FitResult, partition: Record | None
) -> dict[str, float]:
    """Partition + fit + encode; partition time is shared by all scenes of the dataset."""
    seconds = trained.seconds + encode.seconds
    if partition is not None and partition.partition is not None:
        seconds += partition.partition.seconds * len(group) / len(partition.job.scenes)
    return {"group_seconds": seconds, "train_seconds": seconds / len(group)}


def _views(record: Record) -> list[dict[str, Any]]:
    if record.measure is None:
        return []
    return [
        {
            "job": record.job.id,
            **_axes(record.job),
            "split": record.job.split,
            "view": view.view,
            **{name: view.metrics.get(name) for name in METRICS},
            "identical": view.identical,
            "truth_file": view.truth_file,
            "render_file": view.render_file,
        }
        for view in record.measure.views
    ]


def _timing(record: Record) -> list[dict[str, Any]]:
    parts = record.measure.timing if record.measure else {}
    return [
        {"job": record.job.id, **_axes(record.job), "part": part, "seconds": seconds}
        for part, seconds in parts.items()
    ]


def _features(record: Record) -> list[dict[str, Any]]:
    features = record.measure.features if record.measure else {}
    return [
        {"job": record.job.id, **_axes(record.job), "name": name, "values": values}
        for name, values in features.items()
    ]


def _axes(job: Job) -> dict[str, Any]:
    return {
        "dataset": job.dataset_name,
        "scene": job.scenes[0],
        "method": job.method,
        "variant": job.variant,
        "rate": job.rate,
        "preset": job.preset,
        "seed": job.seed,
    }


def _stale(job: Job, fit: Record | None, sources: Mapping[str, str]) -> bool:
    current = sources.get(job.method or "")
    made_with = fit.provenance.source if fit and fit.provenance else None
    return current is not None and made_with is not None and current != made_with


def _needed(by_id: Mapping[str, Record], record: Record | None, kind: str) -> Record | None:
    if record is None:
        return None
    for need in record.job.needs:
        if need.startswith(f"{kind}-"):
            return by_id.get(need)
    return None


def _order(row: dict[str, Any]) -> list[tuple[Any, ...]]:
    """Rows of one experiment together, whatever their jobs' hashes; the sort keeps the order within a job."""
    keys = ("dataset", "scene", "method", "variant", "preset", "seed", "rate", "split")
    return [_natural(row.get(key)) for key in keys]


def _natural(value: Any) -> tuple[Any, ...]:
    """Sorts missing values first, numbers by size, and names as people do: tf2 before tf10."""
    if value is None or isinstance(value, int | float):
        return (value is not None, value or 0)
    parts = re.split(r"(\d+)", value)
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts)
