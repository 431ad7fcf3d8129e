"""Which version of a model the tables show, where a store holds several: a cell must not count twice.

A method's source, its options' defaults or the data may have changed between two runs, and merged bundles
bring what each had. The scenes that a joint method fitted together share bytes and time, so a fit is taken
whole or not at all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bench.records import Job, Record, hash_of
from reports.tables.protocols import together


@dataclass
class _Model:
    """A fit with the rows that were measured on it.

    Attributes:
        cells: what the tables cannot tell apart: dataset, method, variant, preset, split, seed, views.
        edition: what the models of one version have in common: the partition of a joint method, else all that
            decides a fit but its scenes.
    """

    id: str
    cells: tuple[Any, ...]
    scenes: frozenset[str]
    edition: str
    stale: bool
    rows: list[Record] = field(default_factory=list)

    @property
    def finished(self) -> str:
        return max((record.finished for record in self.rows), default="")


def is_stale(job: Job, fit: Record | None, sources: Mapping[str, Sequence[str]]) -> bool:
    """Whether a job's model was fitted by another source of its method than those that count as today's."""
    current = sources.get(job.method or "")
    made_with = fit.provenance.source if fit and fit.provenance else None
    return current is not None and made_with is not None and made_with not in current


def standing(records: Iterable[Record], sources: Mapping[str, Sequence[str]]) -> list[Record]:
    """The records that tables are made of: one version of each model, and one row per cell.

    Of the versions of a method on a dataset (same variant, preset, split, seed and number of views) that of
    the current source goes first, then the one with the most scenes, then the newest. Others give only the
    scenes that those before lack.

    Args:
        records: of a store.
        sources: method -> hashes of its source now.
    """
    by_id = _by_extent({record.job.id: record for record in records})
    models = {record.job.id: _model(record, sources) for record in by_id.values() if record.job.kind == "fit"}
    fits = {name: _fits(record, by_id) for name, record in by_id.items()}
    for name, record in by_id.items():
        if record.job.kind == "measure":
            for fit in fits[name]:
                if fit in models:
                    models[fit].rows.append(record)
    families: dict[tuple[Any, ...], list[_Model]] = defaultdict(list)
    for model in models.values():
        families[model.cells].append(model)
    dropped = {model.id for family in families.values() for model in _older(family)}
    kept = [record for name, record in by_id.items() if not dropped.intersection(fits[name])]
    return _newest_rows(kept)


def _by_extent(by_id: dict[str, Record]) -> dict[str, Record]:
    """Learning of fewer scenes together than others of a dataset is no version but a dataset of its own.

    A scene learned alone is a version, unless others were learned together with other seeds or options only.
    """
    extents = {name: _extent(record, by_id) for name, record in by_id.items()}
    most: dict[tuple[Any, ...], int] = defaultdict(int)
    for name, record in by_id.items():
        for key in (_protocol(record.job), _cell(record.job)):
            most[key] = max(most[key], extents[name])
    made = {}
    for name, record in by_id.items():
        job, count = record.job, extents[name]
        alone = count == 1 == most[_cell(job)]
        if (count > 1 or alone) and count < most[_protocol(job)]:
            job = job.model_copy(update={"dataset_name": together(job.dataset_name, count)})
            record = record.model_copy(update={"job": job})
        made[name] = record
    return made


def _protocol(job: Job) -> tuple[Any, ...]:
    return job.dataset_name, job.preset, job.split, job.request.train_views


def _extent(record: Record, by_id: Mapping[str, Record]) -> int:
    """Of how many scenes a joint method found the groups together; 0 for what it is no model of."""
    fits = [by_id[name] for name in _fits(record, by_id) if name in by_id]
    needs = [name for fit in fits for name in fit.job.needs if name.startswith("partition-")]
    return max((len(by_id[name].job.scenes) for name in needs if name in by_id), default=0)


def _model(fit: Record, sources: Mapping[str, Sequence[str]]) -> _Model:
    job = fit.job
    common = {name: value for name, value in job.identity.items() if name not in ("scenes", "kind")}
    source = fit.provenance.source if fit.provenance else None
    edition = job.identity.get("partition") or hash_of([common, source])
    return _Model(job.id, _cell(job), frozenset(job.scenes), edition, is_stale(job, fit, sources))


def _cell(job: Job) -> tuple[Any, ...]:
    """What rows of all the scenes of a method on a dataset share in the tables."""
    named = (job.dataset_name, job.method, job.variant, job.preset, job.split, job.seed)
    return (*named, job.request.train_views)


def _fits(record: Record, by_id: Mapping[str, Record]) -> list[str]:
    """Ids of the fits that a fit, encode or measure job is about."""
    if record.job.kind == "fit":
        return [record.job.id]
    direct = [name for name in record.job.needs if name.startswith("fit-")]
    encodes = [by_id[name] for name in record.job.needs if name.startswith("encode-") and name in by_id]
    return direct + [fit for encode in encodes for fit in _fits(encode, by_id)]


def _older(family: list[_Model]) -> list[_Model]:
    """Those models whose scenes others stand for."""
    editions: dict[str, list[_Model]] = defaultdict(list)
    for model in family:
        editions[model.edition].append(model)

    def rank(models: list[_Model]) -> tuple[bool, int, str]:
        measured = {scene for model in models if model.rows for scene in model.scenes}
        return not any(model.stale for model in models), len(measured), max(m.finished for m in models)

    order = [
        model
        for models in sorted(editions.values(), key=rank, reverse=True)
        for model in sorted(models, key=_within, reverse=True)
    ]
    taken: set[str] = set()
    older = []
    # What is not measured yet (an interrupted run) stands for nothing that is.
    for model in sorted(order, key=lambda model: not model.rows):
        if model.scenes & taken:
            older.append(model)
        else:
            taken |= model.scenes
    return older


def _within(model: _Model) -> tuple[bool, str]:
    """Of one edition: a partition that failed at first leaves failed fits behind."""
    return any(record.ok for record in model.rows), model.finished


def _newest_rows(records: list[Record]) -> list[Record]:
    """One row per cell, also where a model was measured, or a volume rendered, more than once."""
    best: dict[tuple[Any, ...], Record] = {}
    for record in records:
        if record.job.kind in ("measure", "dvr"):
            cell = _row(record.job)
            there = best.get(cell)
            if there is None or (record.ok, record.finished) > (there.ok, there.finished):
                best[cell] = record
    chosen = {record.job.id for record in best.values()}
    return [
        record for record in records if record.job.kind not in ("measure", "dvr") or record.job.id in chosen
    ]


def _row(job: Job) -> tuple[Any, ...]:
    return (job.kind, *_cell(job), job.shows, bool(job.composition), job.edit, job.rate)
