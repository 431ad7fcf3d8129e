"""The scenes of a fit as a method may see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np

from bench.jobs.context import Context
from bench.records import derived_seed
from datasets.camera import Camera
from datasets.catalogue import open_dataset
from datasets.scene import Dataset
from datasets.views import ViewSet
from datasets.volume import Volume
from methods.interface import SceneInput


def scene_inputs(context: Context) -> list[SceneInput]:
    """What the views jobs stored of the scenes that a job fits.

    With ``--split val`` the validation views (every tenth training view) are left out of the fit and
    given to the method for its choices. With ``--split test`` the fit uses every training view and
    the method gets no validation views. The dataset is opened when a method reads the volume itself.
    """
    job = context.job
    dataset = cache(partial(open_dataset, job.dataset))
    inputs = []
    for name in job.scenes:
        truth = context.truth(name)
        scene = truth.scene()
        train = truth.views("train" if job.split == "val" else "trainval")
        if job.split == "val":
            validation = truth.views("val")
        else:
            validation = ViewSet((), train.images[:0], train.background, train.key)
        seed = derived_seed("cloud", job.dataset_name, name, job.seed)
        inputs.append(
            SceneInput(
                scene=scene,
                train=train,
                validation=validation,
                cloud=truth.cloud(job.cloud_points, seed),
                extent=camera_extent(train.cameras),
                volume=partial(_volume, dataset, scene.variable) if scene.views_folder is None else None,
            )
        )
    return inputs


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 x the greatest distance of a camera from the mean camera centre (3DGS's scene extent)."""
    centres = np.stack([camera.position for camera in cameras])
    return float(1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def _volume(dataset: Callable[[], Dataset], variable: str) -> Volume:
    return dataset().volume(variable)
