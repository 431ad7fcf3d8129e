"""Records of older schemas, read as records of the current one."""

from __future__ import annotations

from typing import Any

from econgs_bench.bench.store.records import SCHEMA, Job, Record, Value

_KNOBS = ("rate_weight", "lambda", "lambda_e")
"""Rate knobs that need a fit for each value, of all methods of schema 2."""


_PARTS_2 = "2026-11-28T09:25:51"
"""When the parts of a frame got their second ruler (:data:`.bench.machine.timing.RULERS`), UTC."""


def migrated(record: Record) -> Record:
    """A record with what later versions of this program add.

    Overrides and rate knob of schema 2 were in the label alone. Frames that were timed before records had a
    ruler had the first one; the parts of a frame the first or second one, by the time of the job's end.
    """
    record = _with_rulers(record)
    if record.schema_version == SCHEMA:
        return record
    overrides = _overrides(record.job)
    knob = next((name for name in _KNOBS if name in overrides), "")
    job = record.job.model_copy(update={"overrides": overrides, "knob": knob})
    return record.model_copy(update={"schema_version": SCHEMA, "job": job})


def _with_rulers(record: Record) -> Record:
    changes: dict[str, Any] = {}
    if record.dvr is not None and record.dvr.ruler is None:
        changes["dvr"] = record.dvr.model_copy(update={"ruler": 1})
    if record.measure is not None and record.measure.ruler is None:
        parts = 1 if record.finished < _PARTS_2 else 2
        changes["measure"] = record.measure.model_copy(update={"ruler": 1, "parts_ruler": parts})
    return record.model_copy(update=changes) if changes else record


def _overrides(job: Job) -> dict[str, Value]:
    """Option -> value of the label "option=value,option=value"."""
    labels = dict(text.split("=", 1) for text in job.variant.split(",") if text)
    typed = job.options | ({} if job.iterations is None else {"iterations": job.iterations})
    return {name: typed.get(name, text) for name, text in labels.items()}
