"""Which records the tables are made of, where a store holds several for one cell: a cell never counts twice.

The newest of a method's version and options of today wins; others are dropped and counted. Scenes that a
joint method fitted together share bytes and time, so a fit is taken as a whole or not at all.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from econgs_bench.bench.jobs.fit import Fit
from econgs_bench.bench.jobs.method import TrainingJob
from econgs_bench.bench.machine.provenance import source_hash
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.interface import MethodSpec
from econgs_bench.methods.options import ITERATIONS, current, declared, resolve, written


def changes(fits: Iterable[Record], methods: Mapping[str, MethodSpec]) -> str:
    """What was another when some fits were made, as "version 3 (today 6)"; "" if nothing.

    Options and iterations are compared with what the fit's preset and overrides come to today. An option that
    is newer than the fit had its default, or the value that it declares for such fits: with the same version
    that leaves results as they were. Not compared are options that are gone, and presets that a suite names
    itself.

    Args:
        fits: records of fit jobs.
        methods: name -> spec of today; fits of other methods have no changes.
    """
    jobs = [fit.job for fit in fits if isinstance(fit.job, TrainingJob)]
    found = (_changes(job, methods[job.method]) for job in jobs if job.method in methods)
    return ", ".join(dict.fromkeys(change for one in found for change in one))


def _changes(job: TrainingJob, spec: MethodSpec) -> list[str]:
    if job.method_version != spec.version:
        return [f"version {job.method_version} (today {spec.version})"]
    if job.preset not in spec.iterations:
        return []
    try:
        settings = resolve(spec, job.preset, job.overrides)
    except DataError:
        return ["options that are refused today"]
    before = {name: one.before for name, one in declared(spec.options).items() if one.before is not None}
    then, today = asdict(spec.options()) | before | current(spec.options, job.options), settings.values
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
        job, made = record.job, record.provenance
        if not isinstance(job, Fit) or not record.ok or made is None or made.source is None:
            continue
        if (name := job.method) not in methods:
            continue
        if job.method_version == methods[name].version:
            sources[name].add(made.source)
    here = {name: source_hash(methods[name]) for name in sources}
    return sorted(name for name, found in sources.items() if here[name] is not None and found != {here[name]})


def elected(lineage: Lineage, methods: Mapping[str, MethodSpec]) -> list[Record]:
    """The records of one fit per scene and cell, and of one measurement per row.

    Only the same question asked again takes a place: other contents, sizes of views, devices and scenes that
    were learned together are cells of their own. Fits without :func:`changes` come first, then newer ones;
    what is not measured yet takes no place.

    Args:
        lineage: the records of a store.
        methods: name -> spec of today.
    """
    finished: dict[str, str] = defaultdict(str)
    for record in lineage:
        for fit in lineage.fits(record) if record.job.kind == "measure" else ():
            finished[fit.job.id] = max(finished[fit.job.id], record.finished)

    def rank(record: Record) -> tuple[bool, bool, str]:
        newest = finished[record.job.id]
        return bool(newest), not changes([record], methods), newest

    models = [record for record in lineage if record.job.kind == "fit"]
    scenes: dict[tuple[Any, ...], set[tuple[str, str | None]]] = defaultdict(set)
    dropped = set()
    for record in sorted(models, key=rank, reverse=True):
        known, covered = lineage.contents(record) or {}, scenes[_cell(record, lineage)]
        own = {(scene, known.get(scene)) for scene in record.job.scenes}
        if covered.isdisjoint(own):
            covered |= own
        else:
            dropped.add(record.job.id)
    current = [record for record in lineage if dropped.isdisjoint(fit.job.id for fit in lineage.fits(record))]
    return _newest_rows(current, lineage)


def scene_choices(lineage: Lineage) -> dict[str, int]:
    """Job -> number of scenes that its joint method learned together, where others of the dataset are more.

    Of several sets of as many scenes, that of the most jobs is the usual one.
    """
    sets: dict[tuple[Any, ...], Counter[tuple[str, ...]]] = defaultdict(Counter)
    for record in lineage:
        if together := lineage.scenes_together(record):
            sets[_protocol(record.job)][together] += 1
    usual = {key: max(own, key=lambda one: (len(one), own[one])) for key, own in sets.items()}
    choices = {}
    for record in lineage:
        together, most = lineage.scenes_together(record), usual.get(_protocol(record.job), ())
        others = len(together) > 1 and set(together) != set(most)
        if together and (len(together) < len(most) or others):
            choices[record.job.id] = len(together)
    return choices


def _protocol(job: Job) -> tuple[Any, ...]:
    return job.dataset_name, job.preset, job.split, job.request.train_views


def _cell(record: Record, lineage: Lineage) -> tuple[Any, ...]:
    """What the rows of all scenes of a method on a dataset have in common."""
    job, request = record.job, record.job.request
    size = (request.width, request.height, request.samples)
    together = lineage.scenes_together(record)
    learned = frozenset((lineage.contents(record) or {}).items()) if together else frozenset()
    return (
        *_protocol(job), *size, *job.cell, job.stress, together, learned,
    )  # fmt: skip


def _newest_rows(records: list[Record], lineage: Lineage) -> list[Record]:
    """One row per cell and truth, also where a model was measured, or a volume rendered, more than once."""
    best: dict[tuple[Any, ...], Record] = {}
    for record in records:
        job = record.job
        if job.shown is not None:
            row = (
                job.kind,
                job.shown,
                *_cell(record, lineage),
                job.subject,
                bool(job.composition),
                job.edit,
            )
            rival = best.get(row)
            if rival is None or (record.ok, record.finished) > (rival.ok, rival.finished):
                best[row] = record
    newest = {record.job.id for record in best.values()}
    return [record for record in records if record.job.shown is None or record.job.id in newest]
