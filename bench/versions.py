"""Which records the tables are made of, where a store holds several for one cell: a cell never counts twice.

The newest of a method's version and options of today wins; others are dropped and counted. Scenes that a
joint method fitted together share bytes and time, so a fit is taken as a whole or not at all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from bench.lineage import Lineage
from bench.provenance import source_hash
from bench.records import Job, Record
from datasets.errors import DataError
from methods.interface import MethodSpec
from methods.options import ITERATIONS, resolve, written

_ROWS = ("measure", "dvr", "complexity")
"""Kinds of jobs that are a row each."""


def changes(fits: Iterable[Record], methods: Mapping[str, MethodSpec]) -> str:
    """What was another when some fits were made, as "version 3 (today 6)"; "" if nothing.

    Options and iterations are compared with what the fit's preset and overrides come to today. An option that
    is newer than the fit had its default: with the same version that leaves results as they were. Not
    compared are options that are gone, and presets that a suite names itself.

    Args:
        fits: records of fit jobs.
        methods: name -> spec of today; fits of other methods have no changes.
    """
    found = (_changes(fit.job, methods[str(fit.job.method)]) for fit in fits if fit.job.method in methods)
    return ", ".join(dict.fromkeys(change for one in found for change in one))


def _changes(job: Job, spec: MethodSpec) -> list[str]:
    _, version = job.identity["method"]
    if version != spec.version:
        return [f"version {version} (today {spec.version})"]
    if job.preset not in spec.iterations:
        return []
    try:
        settings = resolve(spec, job.preset, job.overrides)
    except DataError:
        return ["options that are refused today"]
    then, today = asdict(spec.options()) | job.options, settings.values
    if job.iterations is not None and not job.stress:
        then[ITERATIONS] = job.iterations
        today[ITERATIONS] = settings.budget(len(job.scenes))
    return [
        f"{name} {written(then[name])} (today {written(value)})"
        for name, value in today.items()
        if then[name] != value
    ]


def of_other_source(records: Iterable[Record], methods: Mapping[str, MethodSpec]) -> list[str]:
    """Methods of which some fit has today's version, but not the source that is installed; sorted.

    Not compared is a source that is gone.
    """
    sources: dict[str, set[str]] = defaultdict(set)
    for record in records:
        name, made = record.job.method or "", record.provenance
        if name not in methods or record.fit is None or made is None or made.source is None:
            continue
        if record.job.identity["method"][1] == methods[name].version:
            sources[name].add(made.source)
    here = {name: source_hash(methods[name]) for name in sources}
    return sorted(name for name, found in sources.items() if here[name] is not None and found != {here[name]})


def elected(lineage: Lineage, methods: Mapping[str, MethodSpec], choices: Mapping[str, int]) -> list[Record]:
    """The records of one fit per scene and cell, and of one measurement per row.

    Fits without :func:`changes` come first, then those of more scenes learned together, then newer ones; what
    is not measured yet takes no place.

    Args:
        lineage: the records of a store.
        methods: name -> spec of today.
        choices: job -> scenes learned together (:func:`scene_choices`).
    """
    finished: dict[str, str] = defaultdict(str)
    for record in lineage:
        for fit in lineage.fits(record) if record.job.kind == "measure" else ():
            finished[fit.job.id] = max(finished[fit.job.id], record.finished)

    def rank(record: Record) -> tuple[bool, bool, int, str]:
        newest = finished[record.job.id]
        return bool(newest), not changes([record], methods), lineage.scenes_together(record), newest

    models = [record for record in lineage if record.job.kind == "fit"]
    scenes: dict[tuple[Any, ...], set[str]] = defaultdict(set)
    dropped = set()
    for record in sorted(models, key=rank, reverse=True):
        covered = scenes[(*_cell(record.job), choices.get(record.job.id, 0))]
        if covered.isdisjoint(record.job.scenes):
            covered.update(record.job.scenes)
        else:
            dropped.add(record.job.id)
    current = [record for record in lineage if dropped.isdisjoint(fit.job.id for fit in lineage.fits(record))]
    return _newest_rows(current, choices)


def scene_choices(lineage: Lineage) -> dict[str, int]:
    """Job -> number of scenes that its joint method learned together, where others of the dataset are more.

    A choice of fewer scenes is a row of its own in tables. A scene that was learned alone is one only if no
    model of the same cell learned more: else it is another version of that.
    """
    counts = {record.job.id: lineage.scenes_together(record) for record in lineage}
    most: dict[tuple[Any, ...], int] = defaultdict(int)
    for record in lineage:
        for key in (_protocol(record.job), _cell(record.job)):
            most[key] = max(most[key], counts[record.job.id])
    choices = {}
    for record in lineage:
        count = counts[record.job.id]
        alone = count == 1 == most[_cell(record.job)]
        if (count > 1 or alone) and count < most[_protocol(record.job)]:
            choices[record.job.id] = count
    return choices


def _protocol(job: Job) -> tuple[Any, ...]:
    return job.dataset_name, job.preset, job.split, job.request.train_views


def _cell(job: Job) -> tuple[Any, ...]:
    """What the rows of all scenes of a method on a dataset have in common."""
    return (*_protocol(job), job.method, job.variant, job.seed, job.stress)


def _newest_rows(records: list[Record], choices: Mapping[str, int]) -> list[Record]:
    """One row per cell, also where a model was measured, or a volume rendered, more than once."""
    best: dict[tuple[Any, ...], Record] = {}
    for record in records:
        job = record.job
        if job.kind in _ROWS:
            choice = choices.get(job.id, 0)
            row = (job.kind, *_cell(job), choice, job.subject, bool(job.composition), job.edit, job.rate)
            rival = best.get(row)
            if rival is None or (record.ok, record.finished) > (rival.ok, rival.finished):
                best[row] = record
    newest = {record.job.id for record in best.values()}
    return [record for record in records if record.job.kind not in _ROWS or record.job.id in newest]
