"""What the jobs of a store build on: the models behind a job."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from econgs_bench.bench.store.records import Record


@dataclass(frozen=True)
class ModelRecords:
    """The records behind a model; None for those that the store lacks."""

    encode: Record | None
    fit: Record | None
    partition: Record | None


class Lineage:
    """Records by job, with the models that each job is about.

    Args:
        records: of one store, or of several joined.
    """

    def __init__(self, records: Iterable[Record]) -> None:
        self.by_id = {record.job.id: record for record in records}
        self._needed: dict[tuple[str, str], list[Record]] = {}

    def __iter__(self) -> Iterator[Record]:
        return iter(self.by_id.values())

    def needed(self, record: Record | None, kind: str) -> list[Record]:
        """The jobs of a kind that a job needs; none if the store lacks any of them."""
        if record is None:
            return []
        key = (record.job.id, kind)
        if key not in self._needed:  # a stranger's jobs may all need the same long list
            names = [name for name in record.job.needs if name.startswith(f"{kind}-")]
            whole = all(name in self.by_id for name in names)
            self._needed[key] = [self.by_id[name] for name in names] if whole else []
        return self._needed[key]

    def models(self, record: Record) -> list[ModelRecords]:
        """The models that a fit, encode or measure job is about: several of a composition."""
        return self._models[record.job.id]

    def fits(self, record: Record) -> list[Record]:
        """The fits of these models."""
        return [model.fit for model in self.models(record) if model.fit is not None]

    def scenes_together(self, record: Record) -> tuple[str, ...]:
        """Scenes among which a joint method found its groups; none for jobs of no joint method."""
        partitions = [model.partition for model in self.models(record) if model.partition]
        return max((one.job.scenes for one in partitions), key=len, default=())

    def contents(self, record: Record) -> dict[str, str] | None:
        """Scene -> content hash, of the scenes that decide a job: its own, and those that a fit learned.

        A composition has an entry of its own. None where the content of the job's scenes is not known.
        """
        return self._contents[record.job.id]

    @cached_property
    def _contents(self) -> Mapping[str, dict[str, str] | None]:
        return {record.job.id: self._content(record) for record in self}

    def _content(self, record: Record) -> dict[str, str] | None:
        found: dict[str, str] = {}
        for one in (record, *self.needed(record, "views")):
            scene = one.job.identity.get("scene")
            if one.job.kind in ("views", "dvr", "complexity") and isinstance(scene, str):
                found[one.job.subject] = scene
        trained = [one for model in self.models(record) for one in (model.fit, model.partition) if one]
        for one in (record, *trained):
            found |= dict(_hashes(one.job.identity.get("scenes")))
        return found if {record.job.subject, *record.job.scenes} & found.keys() else None

    @cached_property
    def _models(self) -> Mapping[str, list[ModelRecords]]:
        return {record.job.id: list(self._behind(record)) for record in self}

    def _behind(self, record: Record) -> Iterator[ModelRecords]:
        if record.job.kind == "fit":
            yield ModelRecords(None, record, self._one(record, "partition"))
        else:
            for encode in [record] if record.job.kind == "encode" else self.needed(record, "encode"):
                fit = self._one(encode, "fit")
                yield ModelRecords(encode, fit, self._one(fit, "partition"))

    def _one(self, record: Record | None, kind: str) -> Record | None:
        return next(iter(self.needed(record, kind)), None)


def _hashes(scenes: Any) -> Iterator[tuple[str, str]]:
    """Name and content hash, as fits and partitions have them in their identities."""
    for pair in scenes or ():
        if isinstance(pair, list | tuple) and len(pair) == 2:
            yield str(pair[0]), str(pair[1])
