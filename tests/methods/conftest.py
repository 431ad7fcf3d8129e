"""A tiny scene of known Gaussians, rendered by the torch oracle: what the method must recover."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from datasets.cloud import PointCloud
from datasets.views import ViewSet
from econgs.splat.rasterise import rasterise
from methods.contract.scene import cameras, look_at, tiny_gaussians, tiny_scene
from methods.gaussian_splatting.spec import SPEC
from methods.options import resolve


class Recorder:
    """A monitor that keeps what it is told and checkpoints where it is asked to."""

    def __init__(self, checkpoint_at=()):
        self.checkpoint_at = set(checkpoint_at)
        self.losses, self.counts, self.stages, self.models = [], [], [], []
        self.checkpoints = {}

    def progress(self, iteration, losses, primitives):
        self.losses.append(losses["loss"])
        self.counts.append(primitives)
        assert iteration >= 1

    def due(self, iteration):
        return iteration in self.checkpoint_at

    def pause(self, iteration, model, checkpoint):
        self.models.append(model())
        self.checkpoints[iteration] = checkpoint()

    def stage(self, name):
        self.stages.append(name)


def oracle_views(views, background=(1.0, 1.0, 1.0)):
    images = []
    for camera in views:
        splats = rasterise(**tiny_gaussians(), camera=camera, backend="torch")
        images.append(torch.cat([splats.features, splats.alpha[..., None]], dim=-1).numpy())
    return ViewSet(tuple(views), np.stack(images).astype(np.float32), background, "oracle")


@pytest.fixture(scope="session")
def scene():
    """Twelve training and three validation views; a cloud of noisy points with wrong colors."""
    return tiny_scene("tiny")


@pytest.fixture
def options():
    return resolve(SPEC, "quick").options


def psnr(model, views):
    """Mean over the views of the PSNR of 8-bit images, computed here."""
    values = []
    for i, camera in enumerate(views.cameras):
        rgb, _ = model.render(camera)
        difference = np.round(rgb.numpy() * 255) - np.round(views.composited(i) * 255)
        values.append(10 * math.log10(255**2 / np.mean(difference**2)))
    return float(np.mean(values))


def with_cloud(scene, points, colors=None):
    """The scene with another initial cloud."""
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    colors = np.full_like(points, 0.5) if colors is None else np.asarray(colors, dtype=np.float32)
    return replace(scene, cloud=PointCloud(points, colors))


@pytest.fixture(scope="session")
def tiny():
    """The helpers above, for test modules (which cannot import one another)."""
    return SimpleNamespace(
        Recorder=Recorder,
        look_at=look_at,
        cameras=cameras,
        known=tiny_gaussians,
        views=oracle_views,
        psnr=psnr,
        with_cloud=with_cloud,
    )
