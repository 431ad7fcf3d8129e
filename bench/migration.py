"""Records of older schemas, read as records of the current one."""

from __future__ import annotations

from bench.records import SCHEMA, Job, Record, Value

_KNOBS = ("rate_weight", "lambda", "lambda_e")
"""Rate knobs that need a fit for each value, of all methods of schema 2."""


def migrated(record: Record) -> Record:
    """A record of schema 2 with what schema 3 adds: overrides and rate knob, once in the label alone."""
    if record.schema_version == SCHEMA:
        return record
    overrides = _overrides(record.job)
    knob = next((name for name in _KNOBS if name in overrides), "")
    job = record.job.model_copy(update={"overrides": overrides, "knob": knob})
    return record.model_copy(update={"schema_version": SCHEMA, "job": job})


def _overrides(job: Job) -> dict[str, Value]:
    """Option -> value of the label "option=value,option=value"."""
    labels = dict(text.split("=", 1) for text in job.variant.split(",") if text)
    typed = job.options | ({} if job.iterations is None else {"iterations": job.iterations})
    return {name: typed.get(name, text) for name, text in labels.items()}
