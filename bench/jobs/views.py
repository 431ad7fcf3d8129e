"""The views job: ground truth of a scene, rendered or read, for all jobs after it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from bench.inputs import camera_from_json, camera_to_json
from bench.jobs.context import Context
from bench.records import ViewsResult
from bench.store import write_text
from datasets.errors import DataError
from datasets.views import Split


def run(context: Context) -> ViewsResult:
    """Render (or find in the cache) the views, and keep those that are measured on as PNG files."""
    from bench.inputs import cost_of_views, open_dataset, shown_transfer, views
    from datasets.png import write_png

    job = context.job
    dataset = open_dataset(job.dataset)
    measured: Split = job.split
    keys: dict[str, str] = {}
    cost: dict[str, dict[str, Any]] = {}
    start = time.perf_counter()
    # Nobody trains on a composition or an edited scene.
    only = job.composition or job.edit
    wanted: tuple[Split, ...] = (measured,) if only else ("trainval", measured)
    for split in wanted:
        context.report(stage=f"views: {split}")
        found = views(dataset, job.shows, job.request, split, job.edit)
        keys[split] = found.key
        if (spent := cost_of_views(dataset, job.shows, job.request, split, job.edit)) is not None:
            cost[split] = spent
    seconds = time.perf_counter() - start
    if len(found) == 0:
        raise DataError(
            f"{job.dataset_name}/{job.shows}", f"no views in split {measured!r}", "Use another split"
        )
    folder = context.folder / "truth"
    folder.mkdir(exist_ok=True)
    names = []
    for index, image in enumerate(found.images):
        names.append(f"{index:04d}.png")
        write_png(folder / names[-1], image)
    cameras = [camera_to_json(camera) for camera in found.cameras]
    write_text(context.folder / "cameras.json", json.dumps(cameras))
    background = tuple(float(c) for c in found.background)
    return ViewsResult(
        view_keys=keys,
        background=background,  # type: ignore[arg-type]
        truth={measured: names},
        render_seconds=seconds,
        cost=cost,
        transfer=shown_transfer(dataset, job.shows, job.edit),
    )


def read_cameras(folder: Path) -> list[Any]:
    """Cameras that a views job stored."""
    return [camera_from_json(c) for c in json.loads((folder / "cameras.json").read_text(encoding="utf-8"))]
