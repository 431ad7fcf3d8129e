"""The views job: renders (or reads) the ground truth of a scene and stores it for all jobs after it."""

from __future__ import annotations

import logging
import time

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.truth import write_truth
from econgs_bench.bench.metrics import mean_scores
from econgs_bench.bench.plan.inputs import edit_distance, finer, stressed, transfer_summary, views
from econgs_bench.bench.store.records import ViewsResult
from econgs_bench.bench.suites.stress import part_of
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import cloud_source
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import write_png
from econgs_bench.datasets.views import Split, ViewSet

FLOORS = ("psnr", "psnr_fg", "ssim", "flip", "delta_e_uv")
"""Metrics whose noise floor is measured: all but LPIPS, whose networks are loaded for models alone."""
CONVERGED = 50.0
"""PSNR [dB] of a truth against a finer one, from which it has converged."""

_log = logging.getLogger(__name__)


def run(context: Context) -> ViewsResult:
    """Store the views of a scene; of compositions, edits and other test views only those measured on.

    Raises:
        DataError: the dataset cannot be used, or the split is empty.
    """
    job = context.job
    dataset = stressed(open_dataset(job.dataset), job.subject, job.stress)
    splits: tuple[Split, ...] = ("train", "val") if job.split == "val" else ("trainval", "test")
    stress = part_of(job.stress, "test")
    basic = not (job.composition or job.edit or stress)
    start = time.perf_counter()
    sets: dict[Split, ViewSet] = {}
    for split in splits if basic else (job.split,):
        context.report(stage=f"views: {split}")
        sets[split] = views(dataset, job.subject, job.request, split, job.edit, stress)
    seconds = time.perf_counter() - start
    measured = sets[job.split]
    if len(measured) == 0:
        raise DataError(
            f"{job.dataset_name}/{job.subject}", f"no views in split {job.split!r}", "Use another split"
        )
    floor: dict[str, float | None] = {}
    one_ray: dict[str, float | None] = {}
    floor_seconds = None
    if dataset.kind == "volume":
        context.report(stage="noise floor")
        start = time.perf_counter()
        other = finer(dataset, job.subject, job.request, job.split, job.edit, stress)
        own = [measured.images[place] for place in other.places]
        floor, one_ray = (
            mean_scores(other.finer, images, measured.background, FLOORS) for images in (own, other.one_ray)
        )
        floor_seconds = time.perf_counter() - start
        if (reached := floor["psnr"]) is not None and reached < CONVERGED:
            _log.warning(
                "%s/%s: the truth has not converged: against itself with other rays it reaches %.1f dB, "
                "and what a method has beyond that means nothing",
                job.dataset_name,
                job.subject,
                reached,
            )
    context.report(stage="storing")
    scene = dataset.scene(job.subject) if basic else None
    cloud, cloud_seconds = None, None
    if scene is not None and scene.views_folder is None:
        dataset.volume(scene.variable)  # reading it is no part of the cloud's time
        start = time.perf_counter()
        cloud = cloud_source(dataset, scene)
        cloud_seconds = time.perf_counter() - start
    elif scene is not None:
        cloud = cloud_source(dataset, scene)
    write_truth(context.folder, sets, scene, cloud)
    folder = context.folder / "truth"
    folder.mkdir(exist_ok=True)
    names = [f"{index:04d}.png" for index in range(len(measured))]
    for name, image in zip(names, measured.images, strict=True):
        write_png(folder / name, image)
    return ViewsResult(
        view_keys={split: one.key for split, one in sets.items()},
        background=measured.background,
        truth={job.split: names},
        render_seconds=seconds,
        cost={split: dict(one.cost) for split, one in sets.items() if one.cost is not None},
        distance=edit_distance(dataset, job.subject, job.edit),
        transfer=transfer_summary(dataset, job.subject, job.edit),
        variable="" if scene is None else scene.variable,
        cloud_seconds=cloud_seconds,
        floor=floor,
        one_ray=one_ray,
        floor_seconds=floor_seconds,
    )
