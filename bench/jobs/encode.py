"""The encode job: saves a trained model at a rate."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Mapping
from typing import Literal, Self

from econgs_bench.bench.jobs import returned
from econgs_bench.bench.jobs.checkpoints import read_checkpoint
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.fit import Fit
from econgs_bench.bench.jobs.method import ModelJob
from econgs_bench.bench.machine.timing import synchronise
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Count, Record, Result, Row, Whole
from econgs_bench.bench.store.store import folder_bytes
from econgs_bench.methods.interface import check_ledger


class EncodeResult(Result):
    """A saved model.

    Attributes:
        ledger: scene ("" for what the group shares) -> part -> bytes; sums to ``total_bytes``.
    """

    seconds: float
    total_bytes: Count
    ledger: dict[str, dict[str, Whole]]

    def parts(self) -> Mapping[str, float]:
        return {"encode.seconds": self.seconds}


class Encode(ModelJob):
    """Saves a trained model at a rate."""

    kind: Literal["encode"] = "encode"
    result_type = EncodeResult

    @classmethod
    def of(cls, fit: Fit, rate: float | None) -> Self:
        """The job that saves the model of a fit."""
        return cls.after(fit, {"fit": fit.key, "rate": rate}, needs=(fit.id,), rate=rate)

    def run(self, context: Context) -> EncodeResult:
        """Restore the model of a fit from its checkpoint and save it; the ledger must cover the files."""
        stored = read_checkpoint(context.path_of(context.input("fit")) / "checkpoint")
        if stored is None:
            raise RuntimeError("the fit has no checkpoint")
        context.report(stage="loading")
        model = context.method().restore(stored[0], context.options(self), self.device)
        folder = context.folder / "model"
        shutil.rmtree(folder, ignore_errors=True)  # of an attempt that was killed
        folder.mkdir()
        context.report(stage="encode")
        start = time.perf_counter()
        ledger = returned.ledger(model.save(folder, self.rate))
        synchronise(self.device)
        seconds = time.perf_counter() - start
        total = folder_bytes(folder)
        check_ledger(ledger, total, self.scenes)
        return EncodeResult(seconds=seconds, total_bytes=total, ledger=ledger)

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        result = record.of(EncodeResult)
        ledger = {} if result is None else result.ledger
        rows = [
            {"scene": scene, "part": part, "bytes": count}
            for scene, parts in ledger.items()
            for part, count in parts.items()
        ]
        return {"ledger": rows}
