"""The partition job: which scenes a joint method fits together."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.method import TrainingJob
from econgs_bench.bench.jobs.scenes import scene_inputs
from econgs_bench.bench.machine.timing import synchronise
from econgs_bench.bench.store.records import Result


class PartitionResult(Result):
    """Groups of scenes, by name."""

    groups: list[list[str]]
    seconds: float

    def parts(self) -> Mapping[str, float]:
        return {"partition.seconds": self.seconds}


class Partition(TrainingJob):
    """Asks a joint method which scenes of a dataset it fits together."""

    kind: Literal["partition"] = "partition"
    result_type = PartitionResult

    def run(self, context: Context) -> PartitionResult:
        """Let the method choose groups that hold each scene once."""
        scenes = scene_inputs(self, context)
        method = context.method()
        context.report(stage="partition")
        start = time.perf_counter()
        groups = method.partition(scenes, context.options(self))
        synchronise(self.device)
        seconds = time.perf_counter() - start
        names = [[scene.name for scene in group] for group in groups]
        if sorted(name for group in names for name in group) != sorted(self.scenes):
            raise RuntimeError(f"{self.method} partitioned {list(self.scenes)} into {names}")
        return PartitionResult(groups=names, seconds=seconds)
