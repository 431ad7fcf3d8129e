"""Which records the tables are made of, where a store holds several for one cell: a cell never counts twice.

The newest of a method's current version wins; older ones are dropped and counted. Scenes that a joint method
fitted together share bytes and time, so a fit is taken as a whole or not at all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from bench.records import Job, Record


def is_stale(fits: Iterable[Record], versions: Mapping[str, str]) -> bool:
    """Whether any of some fits was made by a version of its method other than the current one.

    Args:
        fits: records of fit jobs.
        versions: method -> its current version; fits of other methods are not stale.
    """
    used = (fit.job.identity["method"] for fit in fits if "method" in fit.job.identity)
    return any(versions.get(method, version) != version for method, version in used)


def elected(
    records: Iterable[Record], versions: Mapping[str, str], choices: Mapping[str, int]
) -> list[Record]:
    """The records of one fit per scene and cell, and of one measurement per row.

    Fits of the current version come first, then those of more scenes learned together, then newer ones; what
    is not measured yet takes no place.

    Args:
        records: of a store.
        versions: method -> its current version.
        choices: job -> scenes learned together (:func:`scene_choices`).
    """
    by_id = {record.job.id: record for record in records}
    fits = {name: _fits(record, by_id) for name, record in by_id.items()}
    finished: dict[str, str] = defaultdict(str)
    for name, record in by_id.items():
        for fit in fits[name] if record.job.kind == "measure" else ():
            finished[fit] = max(finished[fit], record.finished)

    def rank(record: Record) -> tuple[bool, bool, int, str]:
        newest = finished[record.job.id]
        current = not is_stale([record], versions)
        return bool(newest), current, _scenes_together(record, by_id), newest

    models = [record for record in by_id.values() if record.job.kind == "fit"]
    scenes: dict[tuple[Any, ...], set[str]] = defaultdict(set)
    dropped = set()
    for record in sorted(models, key=rank, reverse=True):
        covered = scenes[(*_cell(record.job), choices.get(record.job.id, 0))]
        if covered.isdisjoint(record.job.scenes):
            covered.update(record.job.scenes)
        else:
            dropped.add(record.job.id)
    current = [record for name, record in by_id.items() if dropped.isdisjoint(fits[name])]
    return _newest_rows(current, choices)


def scene_choices(records: Iterable[Record]) -> dict[str, int]:
    """Job -> number of scenes that its joint method learned together, where others of the dataset are more.

    A choice of fewer scenes is a row of its own in tables. A scene that was learned alone is one only if no
    model of the same cell learned more: else it is another version of that.
    """
    by_id = {record.job.id: record for record in records}
    counts = {name: _scenes_together(record, by_id) for name, record in by_id.items()}
    most: dict[tuple[Any, ...], int] = defaultdict(int)
    for name, record in by_id.items():
        for key in (_protocol(record.job), _cell(record.job)):
            most[key] = max(most[key], counts[name])
    choices = {}
    for name, record in by_id.items():
        count = counts[name]
        alone = count == 1 == most[_cell(record.job)]
        if (count > 1 or alone) and count < most[_protocol(record.job)]:
            choices[name] = count
    return choices


def _scenes_together(record: Record, by_id: Mapping[str, Record]) -> int:
    """Scenes among which a joint method found its groups; 0 for jobs of no joint method."""
    fits = [by_id[name] for name in _fits(record, by_id) if name in by_id]
    partitions = [name for fit in fits for name in fit.job.needs if name.startswith("partition-")]
    return max((len(by_id[name].job.scenes) for name in partitions if name in by_id), default=0)


def _protocol(job: Job) -> tuple[Any, ...]:
    return job.dataset_name, job.preset, job.split, job.request.train_views


def _cell(job: Job) -> tuple[Any, ...]:
    """What the rows of all scenes of a method on a dataset have in common."""
    return (*_protocol(job), job.method, job.variant, job.seed)


def _fits(record: Record, by_id: Mapping[str, Record]) -> list[str]:
    """Ids of the fits that a fit, encode or measure job builds on."""
    if record.job.kind == "fit":
        return [record.job.id]
    direct = [name for name in record.job.needs if name.startswith("fit-")]
    encodes = [by_id[name] for name in record.job.needs if name.startswith("encode-") and name in by_id]
    return direct + [fit for encode in encodes for fit in _fits(encode, by_id)]


def _newest_rows(records: list[Record], choices: Mapping[str, int]) -> list[Record]:
    """One row per cell, also where a model was measured, or a volume rendered, more than once."""
    best: dict[tuple[Any, ...], Record] = {}
    for record in records:
        job = record.job
        if job.kind in ("measure", "dvr"):
            choice = choices.get(job.id, 0)
            row = (job.kind, *_cell(job), choice, job.subject, bool(job.composition), job.edit, job.rate)
            rival = best.get(row)
            if rival is None or (record.ok, record.finished) > (rival.ok, rival.finished):
                best[row] = record
    newest = {record.job.id for record in best.values()}
    return [
        record for record in records if record.job.kind not in ("measure", "dvr") or record.job.id in newest
    ]
