"""What the jobs of a store build on: the models behind a job."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from bench.records import Record


@dataclass(frozen=True)
class Model:
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

    def __iter__(self) -> Iterator[Record]:
        return iter(self.by_id.values())

    def needed(self, record: Record | None, kind: str) -> list[Record]:
        """The jobs of a kind that a job needs; none if the store lacks any of them."""
        names = [n for n in record.job.needs if n.startswith(f"{kind}-")] if record is not None else []
        return [self.by_id[name] for name in names] if all(name in self.by_id for name in names) else []

    def models(self, record: Record) -> list[Model]:
        """The models that a fit, encode or measure job is about: several of a composition."""
        return self._models[record.job.id]

    def fits(self, record: Record) -> list[Record]:
        """The fits of these models."""
        return [model.fit for model in self.models(record) if model.fit is not None]

    def scenes_together(self, record: Record) -> tuple[str, ...]:
        """Scenes among which a joint method found its groups; none for jobs of no joint method."""
        partitions = [model.partition for model in self.models(record) if model.partition]
        return max((one.job.scenes for one in partitions), key=len, default=())

    @cached_property
    def _models(self) -> Mapping[str, list[Model]]:
        return {record.job.id: list(self._behind(record)) for record in self}

    def _behind(self, record: Record) -> Iterator[Model]:
        if record.job.kind == "fit":
            yield Model(None, record, self._one(record, "partition"))
        else:
            for encode in [record] if record.job.kind == "encode" else self.needed(record, "encode"):
                fit = self._one(encode, "fit")
                yield Model(encode, fit, self._one(fit, "partition"))

    def _one(self, record: Record | None, kind: str) -> Record | None:
        return next(iter(self.needed(record, kind)), None)
