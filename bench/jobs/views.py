"""The views job: renders (or reads) the ground truth of a scene and stores it for all jobs after it."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.scene import SceneJob
from econgs_bench.bench.jobs.scene_views import edit_distance, finer, stressed, transfer_summary, views
from econgs_bench.bench.jobs.truth import write_truth
from econgs_bench.bench.metrics import mean_scores
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import PictureFile, Record, Result, Row
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


class ViewsResult(Result):
    """What :mod:`.bench.jobs.truth` stored.

    Attributes:
        view_keys: split -> content hash of its views.
        truth: the measured split -> PNG file names, in the order of its cameras.
        render_seconds: time that this job waited for the views.
        cost: split -> cost of rendering its views (:attr:`.datasets.views.ViewSet.cost`), renderer and
            version among it; empty for pre-rendered views.
        distance: distance in [0, 1] of the transfer functions from those before the edit
            (:func:`.datasets.unseen.transfer_distance`); None without an edit of them.
        transfer: part -> its transfer function and isosurfaces, by
            :func:`.bench.jobs.scene_views.transfer_summary`; empty for pre-rendered views.
        variable: what a basic scene shows; "" for others.
        cloud_seconds: from the volume in memory to the candidates of initial clouds; None without a volume.
        floor: metric -> what the truth itself reaches against the same views rendered with other, more rays
            (:func:`.datasets.render_views.finer_views`), mean over some of the measured views; empty for
            pre-rendered views and in older records.
        one_ray: metric -> what one ray a pixel reaches against these.
        floor_seconds: time that this took.
    """

    long: ClassVar[Mapping[str, str]] = {"scenes": "transfer"}

    view_keys: dict[str, str]
    background: tuple[float, float, float]
    truth: dict[str, list[PictureFile]]
    render_seconds: float
    cost: dict[str, dict[str, Any]] = Field(default_factory=dict)
    distance: float | None = None
    transfer: dict[str, dict[str, list[list[float]]]] = Field(default_factory=dict)
    variable: str = ""
    cloud_seconds: float | None = None
    floor: dict[str, float | None] = Field(default_factory=dict)
    one_ray: dict[str, float | None] = Field(default_factory=dict)
    floor_seconds: float | None = None

    def parts(self) -> Mapping[str, float]:
        return {"render_seconds": self.render_seconds}

    @property
    def reached(self) -> dict[str, Mapping[str, float | None]]:
        """Picture -> metric -> what it reaches against truth of other rays; empty where not known."""
        return {"truth": self.floor, "one ray": self.one_ray} if self.floor else {}


class Views(SceneJob):
    """Renders (or reads) the ground truth of a scene and stores it for all jobs after it."""

    kind: Literal["views"] = "views"
    result_type = ViewsResult

    @classmethod
    def protocol(cls, about: Mapping[str, Any]) -> dict[str, Any]:
        return {"request": about["request"].identity, "split": about["split"]}

    def run(self, context: Context) -> ViewsResult:
        """Store the views of a scene; of compositions, edits and other test views only those measured on.

        Raises:
            DataError: the dataset cannot be used, or the split is empty.
        """
        dataset = stressed(open_dataset(self.dataset), self.subject, self.stress)
        splits: tuple[Split, ...] = ("train", "val") if self.split == "val" else ("trainval", "test")
        stress = part_of(self.stress, "test")
        basic = not (self.composition or self.edit or stress)
        start = time.perf_counter()
        sets: dict[Split, ViewSet] = {}
        for split in splits if basic else (self.split,):
            context.report(stage=f"views: {split}")
            sets[split] = views(dataset, self.subject, self.request, split, self.edit, stress)
        seconds = time.perf_counter() - start
        measured = sets[self.split]
        if len(measured) == 0:
            raise DataError(
                f"{self.dataset_name}/{self.subject}",
                f"no views in split {self.split!r}",
                "Use another split",
            )
        floor: dict[str, float | None] = {}
        one_ray: dict[str, float | None] = {}
        floor_seconds = None
        if dataset.kind == "volume":
            context.report(stage="noise floor")
            start = time.perf_counter()
            other = finer(dataset, self.subject, self.request, self.split, self.edit, stress)
            own = [measured.images[place] for place in other.places]
            floor, one_ray = (
                mean_scores(other.finer, images, measured.background, FLOORS)
                for images in (own, other.one_ray)
            )
            floor_seconds = time.perf_counter() - start
            if (reached := floor["psnr"]) is not None and reached < CONVERGED:
                _log.warning(
                    "%s/%s: the truth has not converged: against itself with other rays it reaches %.1f dB, "
                    "and what a method has beyond that means nothing",
                    self.dataset_name,
                    self.subject,
                    reached,
                )
        context.report(stage="storing")
        scene = dataset.scene(self.subject) if basic else None
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
            truth={self.split: names},
            render_seconds=seconds,
            cost={split: dict(one.cost) for split, one in sets.items() if one.cost is not None},
            distance=edit_distance(dataset, self.subject, self.edit),
            transfer=transfer_summary(dataset, self.subject, self.edit),
            variable="" if scene is None else scene.variable,
            cloud_seconds=cloud_seconds,
            floor=floor,
            one_ray=one_ray,
            floor_seconds=floor_seconds,
        )

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        result = record.of(ViewsResult)
        if result is None:
            return {}
        scene = {
            "transfer": json.dumps(result.transfer, separators=(",", ":")),
            "variable": result.variable or None,
            "cloud_seconds": result.cloud_seconds,
        }
        floors = [{"picture": name, **reached} for name, reached in result.reached.items()]
        return {"scenes": [scene] if result.transfer else [], "floors": floors}
