"""The scenes of a fit as a method may see them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.store.records import derived_seed
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.scratch import picked
from econgs_bench.datasets.stress import (
    noisy,
    one_sided,
    scattered_cloud,
    spread_out,
    turned,
    with_outliers,
)
from econgs_bench.datasets.views import Split, ViewSet
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.interface import Refused, SceneInput
from econgs_bench.methods.shared.units import in_units


def scene_inputs(job: MethodJob, context: Context) -> list[SceneInput]:
    """What the views jobs stored of the scenes that a job fits.

    With ``--split val`` the validation views (every tenth training view) are left out of the fit and
    given to the method for its choices. With ``--split test`` the fit uses every training view and
    the method gets no validation views. Views that together pass :data:`.datasets.scratch.LIMIT` lie in a
    file. The dataset is opened when a method reads the volume itself.
    Stress on the training input (:mod:`.bench.suites.stress`) changes training views and cloud, nothing else.

    Raises:
        Refused: a method that reads the volume itself is to work in other scene units.
    """
    dataset = cache(partial(open_dataset, job.dataset))
    stress = stress_of(job.stress)
    units = stress.get("units", 1.0)
    if units != 1.0 and context.spec is not None and context.spec.needs_volume:
        raise Refused(f"{job.method} reads the volume itself, which has no other scene units")
    splits: tuple[Split, ...] = ("train", "val") if job.split == "val" else ("trainval",)
    truths = {name: context.truth(name) for name in job.scenes}
    together = sum(truth.images_bytes(split) for truth in truths.values() for split in splits)
    inputs = []
    for name, truth in truths.items():
        scene = truth.scene()
        train = truth.views(splits[0], together=together)
        if job.split == "val":
            validation = truth.views("val", together=together)
        else:
            validation = ViewSet((), train.images[:0], train.background, train.key)
        seed = derived_seed("cloud", job.dataset_name, name, job.seed)
        points = stress.get("points", job.cloud_points)
        if (start := stress.get("start")) == "random":
            cloud = scattered_cloud(train.cameras, points, seed)
        else:
            cloud = truth.cloud(points, seed)
            if start == "outliers":
                cloud = with_outliers(cloud, train.cameras, seed)
        train = _stressed(train, stress, derived_seed("stress", job.dataset_name, name, job.seed))
        scene_input = SceneInput(
            scene=scene,
            train=train,
            validation=validation,
            cloud=cloud,
            extent=camera_extent(train.cameras),
            volume=partial(_volume, dataset, scene.variable) if scene.views_folder is None else None,
        )
        inputs.append(in_units(scene_input, units))
    return inputs


def _stressed(train: ViewSet, stress: Mapping[str, Any], seed: int) -> ViewSet:
    """Fewer training views, with noise and false directions."""
    if "cameras" in stress:
        train = _some(train, one_sided(train.cameras, stress["cameras"]))
    if "views" in stress:
        train = _some(train, spread_out(train.cameras, stress["views"]))
    generator = np.random.default_rng(seed)
    if "noise" in stress:
        train = replace(train, images=noisy(train.images, stress["noise"], generator))
    if "poses" in stress:
        cameras = tuple(turned(camera, stress["poses"], generator) for camera in train.cameras)
        train = replace(train, cameras=cameras)
    return train


def _some(views: ViewSet, which: list[int]) -> ViewSet:
    return replace(views, cameras=tuple(views.cameras[i] for i in which), images=picked(views.images, which))


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 x the greatest distance of a camera from the mean camera centre (3DGS's scene extent)."""
    centres = np.stack([camera.position for camera in cameras])
    return float(1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def _volume(dataset: Callable[[], Dataset], variable: str) -> Volume:
    return dataset().volume(variable)
