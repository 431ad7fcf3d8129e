"""A store of comparable records of two methods, in which a difference can be planted."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.measure import MeasureResult
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.store.records import (
    KINDS,
    CurvePoint,
    Provenance,
    Record,
    Request,
    ViewResult,
    kind_of,
)
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry

SCENES = ("TF01", "TF02", "TF03", "TF04")
METHODS = ("3dgs", "ivr-gs")
SPECS = Registry().specs
RATES = (None, 1.0, 2.0, 3.0)
SEEDS = (0, 1, 2)
LENGTHS = (None, 300)
VIEWS = 6
FLOOR = {"psnr": 52.5, "psnr_fg": 49.5, "ssim": 0.999, "flip": 0.002, "delta_e_uv": 0.05}
ONE_RAY = {"psnr": 31.5, "psnr_fg": 28.5, "ssim": 0.95, "flip": 0.05, "delta_e_uv": None}
"""What the truth, and one ray a pixel, reach on every scene whose rays are as many as needed."""


@dataclass(frozen=True)
class Facts:
    """What a measurement is of; a plant changes it for the rows of one method."""

    method: str
    scene: str
    seed: int
    rate: float | None
    length: int | None
    content: str = "c0"
    split: str = "test"
    test_views: int = VIEWS
    views: tuple[int, ...] = tuple(range(VIEWS))
    size: int = 200
    samples: int = 0
    metrics: dict[str, str] = field(default_factory=lambda: {"psnr": "1", "ssim": "1"})
    ruler: int | None = 2
    cpu: str = "EPYC"
    threads: int = 1
    device: str = "cpu"
    kernel: float = 0.03
    spread: float = 1.1
    version: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    renderer: str = "mitsuba 3"
    shade: float = 0.5
    known: bool = True
    made: bool = True


Plant = Callable[[Facts], Facts]


def every(
    plant: Plant,
    scenes: Sequence[str] = SCENES,
    seeds: Sequence[int] = SEEDS,
    rates: Sequence[float | None] = RATES,
    lengths: Sequence[int | None] = LENGTHS,
) -> list[Record]:
    """The records of both methods; what was fitted for another length than the usual, None, has no rates."""
    records: dict[str, Record] = {}
    for method in METHODS:
        for scene, seed, length in product(scenes, seeds, lengths):
            for rate in rates if length is None else (None,):
                facts = Facts(method, scene, seed, rate, length)
                facts = plant(facts) if method == METHODS[1] else facts
                for record in _of(facts) if facts.made else ():
                    records[record.job.id] = record
    return list(records.values())


def write(folder: Path, records: Iterable[Record]) -> Store:
    """A store with these records."""
    store = Store(folder, create=True)
    for record in records:
        store.finish(record)
    return store


def _of(facts: Facts) -> Iterator[Record]:
    spec = SPECS[facts.method]
    settings = resolve(spec, "quick", {} if facts.length is None else {"iterations": facts.length})
    request = Request(
        train_views=42, test_views=facts.test_views, width=facts.size, height=facts.size,
        samples=facts.samples,
    )  # fmt: skip
    common = {
        "dataset": "vortex_views", "dataset_name": "vortex_views", "request": request, "preset": "quick",
        "split": facts.split, "scenes": (facts.scene,),
    }  # fmt: skip
    where = Provenance(
        machine="vm", cpu=facts.cpu, cores=2, usable=1, threads=facts.threads, memory_bytes=2**34, gpu=None,
        system="Linux", python="3.11", versions={}, isa="avx512", commit=None, source=None,
    )  # fmt: skip

    def record(kind: str, identity: dict[str, Any], **said: Any) -> Record:
        own = kind_of(kind)
        fields = {name: said.pop(name) for name in list(said) if name not in KINDS}
        identity = {"kind": kind, **identity}
        job = own(kind=kind, key=hash_of(identity), identity=identity, **common, **fields)
        time = f"2026-11-0{1 if facts.content == 'c0' else 2}T00:00:00.000+00:00"
        return Record(
            job=job,
            status="ok",
            started=time,
            finished=time,
            wall_seconds=100.0,
            provenance=where,
            peak_host_bytes=2**28,
            **said,
        )

    content = hash_of([facts.scene, facts.content])
    names = [f"r_{i:04d}" for i in range(facts.test_views)]
    views = record(
        "views",
        {"scene": content, "request": request.identity, "split": facts.split},
        views=ViewsResult(
            view_keys={}, background=(1.0, 1.0, 1.0), render_seconds=0.1,
            truth={facts.split: [f"{i:04d}.png" for i in range(facts.test_views)]},
            cost={facts.split: {"renderer": facts.renderer.split()[0], "version": "3"}},
            floor=FLOOR if facts.samples == 0 else {}, one_ray=ONE_RAY if facts.samples == 0 else {},
        ),
    )  # fmt: skip
    trained = {
        "method": facts.method, "seed": facts.seed, "device": facts.device, "group": facts.scene,
        "options": settings.values | facts.options, "overrides": settings.overrides,
        "variant": settings.variant, "iterations": settings.budget(1),
    }  # fmt: skip
    pairs = [[facts.scene, content]] if facts.known else [facts.scene]
    version = facts.version or spec.version
    seconds = 10.0 if facts.length is None else 4.0
    point = CurvePoint(
        iteration=1, train_seconds=seconds, loss=None, psnr={facts.scene: 20.0}, primitives=1000
    )
    fit = record(
        "fit",
        {"scenes": pairs, "method": [facts.method, version], "seed": facts.seed, "views": views.job.key,
         "options": trained["options"], "iterations": trained["iterations"], "device": facts.device},
        needs=(views.job.id,),
        fit=FitResult(
            seconds=seconds, cpu_seconds=seconds, iterations=trained["iterations"], train_views=42,
            curve=[point], primitives={facts.scene: 1000}, resumed=0, reference_seconds=facts.kernel,
        ),
        **trained,
    )  # fmt: skip
    factor = 1.0 if facts.rate is None else 0.4 * facts.rate
    size = int(100_000 * factor)
    encode = record(
        "encode", {"fit": fit.job.key, "rate": facts.rate}, needs=(fit.job.id,), rate=facts.rate,
        encode=EncodeResult(seconds=0.1, total_bytes=size, ledger={facts.scene: {"all": size}}), **trained,
    )  # fmt: skip
    yield from (views, fit, encode)
    psnr = 30.0 + SCENES.index(facts.scene) + 0.1 * facts.seed + 2 * np.log(factor)
    psnr += (1.0 if facts.method == METHODS[1] else 0.0) - (1.0 if facts.length else 0.0)
    rows = [
        ViewResult(
            view=names[i], metrics={"psnr": psnr + 0.01 * (i - 2.5), "ssim": 0.9}, identical=False,
            truth_file=f"jobs/{views.job.id}/truth/{i:04d}.png", render_file=f"jobs/x/renders/{i:04d}.png",
        )
        for i in facts.views
        if i < facts.test_views
    ]  # fmt: skip
    values = np.full((facts.test_views, 8), facts.shade)
    sketch = base64.b64encode(np.round(values * 65535).astype("<u2").tobytes()).decode()
    frame_seconds = 0.01 if facts.method == METHODS[0] else 0.005
    identity = {
        "encode": encode.job.key,
        "scene": facts.scene,
        "split": facts.split,
        "metrics": facts.metrics,
    }
    yield record(
        "measure",
        {**identity, **({"views": views.job.key} if facts.known else {})},
        needs=(views.job.id, encode.job.id) if facts.known else (encode.job.id,),
        rate=facts.rate,
        metrics=facts.metrics,
        measure=MeasureResult(
            load_seconds=0.1, frame_seconds=frame_seconds, frame_seconds_p05=frame_seconds,
            frame_seconds_p95=frame_seconds * facts.spread, frames=10, warmup_frames=5, warmup_stable=True,
            reference_seconds=facts.kernel, timing={"frame": frame_seconds}, primitives=1000,
            metrics={"psnr": float(np.mean([row.metrics["psnr"] for row in rows])), "ssim": 0.9},
            missing={}, views=rows, renderer=facts.renderer, sketch=sketch, drawn=500.0,
            ruler=facts.ruler, parts_ruler=2,
        ),
        **trained,
    )  # fmt: skip
