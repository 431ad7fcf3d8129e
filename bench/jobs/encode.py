"""The encode job: saves a trained model at a rate."""

from __future__ import annotations

import shutil
import time

from econgs_bench.bench.jobs import answers
from econgs_bench.bench.jobs.checkpoints import read_checkpoint
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.machine.timing import synchronise
from econgs_bench.bench.store.records import EncodeResult
from econgs_bench.methods.interface import check_ledger


def run(context: Context) -> EncodeResult:
    """Restore the model of a fit from its checkpoint and save it; the ledger must cover the files."""
    job = context.job
    stored = read_checkpoint(context.path_of(context.input("fit")) / "checkpoint")
    if stored is None:
        raise RuntimeError("the fit has no checkpoint")
    context.report(stage="loading")
    model = context.method().restore(stored[0], context.options, job.device)
    folder = context.folder / "model"
    shutil.rmtree(folder, ignore_errors=True)  # of an attempt that was killed
    folder.mkdir()
    context.report(stage="encode")
    start = time.perf_counter()
    ledger = answers.ledger(model.save(folder, job.rate))
    synchronise(job.device)
    seconds = time.perf_counter() - start
    total = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    check_ledger(ledger, total, job.scenes)
    return EncodeResult(seconds=seconds, total_bytes=total, ledger=ledger)
