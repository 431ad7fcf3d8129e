"""Fits of a tiny scene of known Gaussians, rendered by the torch oracle: what the method must recover."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.methods.contract import checks
from econgs_bench.methods.contract.scene import look_at, tiny_gaussians, tiny_scene
from econgs_bench.methods.interface import Budget
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry, load_method
from tests.econgs.conftest import isa as isa
from tests.econgs.conftest import restored as restored


class Fits:
    """Fits of a method at the preset quick.

    Args:
        name: the method.
        small: option values that differ, for a small model.
    """

    def __init__(self, name, **small):
        self.spec, self.small = Registry().spec(name), small
        self.method = load_method(self.spec)

    def options(self, **changed):
        return resolve(self.spec, "quick", self.small | changed).options

    def __call__(self, scenes, recorder, iterations, seed=0, resume=None, **changed):
        """The model of a scene, or of several learned together."""
        group = scenes if isinstance(scenes, list) else [scenes]
        budget = Budget(iterations)
        return self.method.fit(group, self.options(**changed), budget, seed, "cpu", recorder, resume)


class Recorder(checks.Recorder):
    """Keeps numbers of primitives, stages and the models of its pauses as well."""

    def __init__(self, checkpoint_at=()):
        super().__init__(checkpoint_at)
        self.counts, self.stages, self.models = [], [], []

    def progress(self, iteration, losses, primitives):
        super().progress(iteration, losses, primitives)
        self.counts.append(primitives)

    def pause(self, iteration, model, checkpoint):
        super().pause(iteration, model, checkpoint)
        self.models.append(model())

    def stage(self, name):
        self.stages.append(name)


@pytest.fixture(scope="session")
def scene():
    """Twelve training and three validation views; a cloud of noisy points with wrong colors."""
    return tiny_scene("tiny")


def psnr(model, views, **arguments):
    """Mean over the views of the PSNR of 8-bit images, computed here."""
    values = []
    for i, camera in enumerate(views.cameras):
        rgb, _ = model.render(camera, background=views.background, **arguments)
        difference = np.round(rgb.numpy() * 255) - np.round(views.composited(i) * 255)
        values.append(10 * math.log10(255**2 / np.mean(difference**2)))
    return float(np.mean(values))


def with_cloud(scene, points, colors=None):
    """The scene with another initial cloud."""
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    colors = np.full_like(points, 0.5) if colors is None else np.asarray(colors, dtype=np.float32)
    return replace(scene, cloud=PointCloud(points, colors))


def renamed(scene, name):
    return replace(scene, scene=replace(scene.scene, name=name))


@pytest.fixture(scope="session")
def tiny():
    """The helpers above, for test modules (which cannot import one another)."""
    return SimpleNamespace(
        Recorder=Recorder,
        look_at=look_at,
        known=tiny_gaussians,
        psnr=psnr,
        with_cloud=with_cloud,
        renamed=renamed,
    )
