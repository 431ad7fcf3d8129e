"""The dvr job: what direct volume rendering costs, the yardstick of every representation that replaces it."""

from __future__ import annotations

import time

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.machine.timing import time_frames
from econgs_bench.bench.plan.inputs import view_request
from econgs_bench.bench.store.records import DvrResult
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.memory import peak_drjit_device_bytes, peak_host_bytes
from econgs_bench.datasets.render_views import live_renderer


def run(context: Context) -> DvrResult:
    """Time one view after the other on the test path, as an interactive viewer would draw them.

    Nothing comes from the cache of views, where several small views share a launch and nobody waits for one.
    """
    job = context.job
    dataset = open_dataset(job.dataset)
    context.report(stage="loading")
    start = time.perf_counter()
    variables = list(dict.fromkeys(part.variable for part in dataset.parts(job.subject)))
    volumes = [dataset.volume(variable) for variable in variables]
    load_seconds = time.perf_counter() - start
    context.report(stage="set-up")
    live = live_renderer(dataset, job.subject, view_request(job.request, job.split))
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
