"""The dvr job: what direct volume rendering costs, the yardstick of every representation that replaces it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, Literal

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.costs import memory
from econgs_bench.bench.jobs.scene import SceneJob
from econgs_bench.bench.jobs.scene_views import view_request
from econgs_bench.bench.machine.timing import RULERS, time_frames
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Count, FrameTimes, Record, Row
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.memory import peak_drjit_device_bytes, peak_host_bytes
from econgs_bench.datasets.render_views import live_renderer


class DvrResult(FrameTimes):
    """Cost of direct volume rendering, view by view as an interactive viewer would draw.

    Attributes:
        dims: nx, ny, nz of the first variable.
        volume_bytes: size of all variables in memory, as ``dtype``.
        load_seconds: time to read the volumes.
        setup_seconds: time from the volumes in memory to the first picture, compilation included.
    """

    dims: tuple[Count, Count, Count]
    variables: list[str]
    dtype: str
    volume_bytes: Count
    load_seconds: float
    setup_seconds: float
    renderer: str
    version: str
    backend: str

    def parts(self) -> Mapping[str, float]:
        return {"dvr.load_seconds": self.load_seconds}


class Dvr(SceneJob):
    """Times direct volume rendering of a scene or composition."""

    kind: Literal["dvr"] = "dvr"
    result_type = DvrResult

    @classmethod
    def protocol(cls, about: Mapping[str, Any]) -> dict[str, Any]:
        return {"request": about["request"].identity, "rulers": {"frame": RULERS["frame"]}}

    @property
    def shown(self) -> Any:
        return self.identity.get("scene")

    def run(self, context: Context) -> DvrResult:
        """Time one view after the other on the test path, as an interactive viewer would draw them.

        Nothing comes from the cache of views, where several small views share a launch and nobody waits for
        one.
        """
        dataset = open_dataset(self.dataset)
        context.report(stage="loading")
        start = time.perf_counter()
        variables = list(dict.fromkeys(part.variable for part in dataset.parts(self.subject)))
        volumes = [dataset.volume(variable) for variable in variables]
        load_seconds = time.perf_counter() - start
        context.report(stage="set-up")
        live = live_renderer(dataset, self.subject, view_request(self.request, self.split))
        context.report(stage="timing")
        # Each picture is copied to the host, so the clock stops when it is there.
        frames = time_frames(live.render, live.cameras, "cpu")
        context.peak_host_bytes = peak_host_bytes()
        context.peak_device_bytes = peak_drjit_device_bytes()
        return DvrResult(
            dims=volumes[0].dims,
            variables=variables,
            dtype=str(volumes[0].values.dtype),
            volume_bytes=sum(volume.values.nbytes for volume in volumes),
            load_seconds=load_seconds,
            setup_seconds=live.setup_seconds,
            **live.about,
            **frames.model_dump(),
        )

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        return {
            "dvr": [{"status": record.status, "reason": record.reason, **memory(record), **_costs(record)}]
        }

    def migrated(self, record: Record) -> Record:
        """Frames that were timed before records had a ruler had the first one."""
        record = super().migrated(record)
        result = record.of(DvrResult)
        if result is None or result.ruler is not None:
            return record
        return record.model_copy(update={"result": result.model_copy(update={"ruler": 1})})


def _costs(record: Record) -> Row:
    cost = record.of(DvrResult)
    if cost is None:
        return {}
    same = ("dtype", "volume_bytes", "load_seconds", "setup_seconds", "renderer", "version", "backend",
            "reference_seconds")  # fmt: skip
    return (
        dict(zip(("nx", "ny", "nz"), cost.dims, strict=True))
        | {name: getattr(cost, name) for name in same}
        | {
            "variables": ";".join(cost.variables),
            "ms_per_view": 1e3 * (cost.frame_seconds or 0.0),
            "ms_p05": 1e3 * (cost.frame_seconds_p05 or 0.0),
            "ms_p95": 1e3 * (cost.frame_seconds_p95 or 0.0),
            "fps": cost.rates()["fps"],
        }
    )
