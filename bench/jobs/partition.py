"""The partition job: which scenes a joint method fits together."""

from __future__ import annotations

import time

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.scenes import scene_inputs
from econgs_bench.bench.machine.timing import synchronise
from econgs_bench.bench.store.records import PartitionResult


def run(context: Context) -> PartitionResult:
    """Let the method choose groups that hold each scene once."""
    job = context.job
    scenes = scene_inputs(context)
    method = context.method()
    context.report(stage="partition")
    start = time.perf_counter()
    groups = method.partition(scenes, context.options)
    synchronise(job.device)
    seconds = time.perf_counter() - start
    names = [[scene.name for scene in group] for group in groups]
    if sorted(name for group in names for name in group) != sorted(job.scenes):
        raise RuntimeError(f"{job.method} partitioned {list(job.scenes)} into {names}")
    return PartitionResult(groups=names, seconds=seconds)
