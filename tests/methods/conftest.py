"""A tiny scene of known Gaussians, rendered by the torch oracle: what the method must recover."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from datasets.camera import Camera
from datasets.cloud import PointCloud
from datasets.scene import BasicScene
from datasets.views import ViewSet
from econgs.splat.rasterise import rasterise
from methods.gaussian_splatting.spec import SPEC
from methods.interface import SceneInput
from methods.options import resolve

SIZE = 32
KNOWN = 24


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


def look_at(position, width=SIZE, height=SIZE, fov=0.5):
    """A camera at ``position`` that looks at the origin."""
    position = np.asarray(position, dtype=float)
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return Camera.with_fov(pose, fov, width, height)


def cameras(count, phase=0.0):
    """Cameras on a spiral around the origin at distance 3."""
    found = []
    for i in range(count):
        z = 0.8 * (2.0 * (i + 0.5) / count - 1.0)
        turn = 2.399963 * i + phase
        radius = math.sqrt(1.0 - z * z)
        found.append(look_at(3.0 * np.array([radius * math.cos(turn), radius * math.sin(turn), z])))
    return tuple(found)


def known_gaussians():
    generator = torch.Generator().manual_seed(7)
    return {
        "means": (torch.rand((KNOWN, 3), generator=generator) - 0.5) * 0.9,
        "quats": torch.randn((KNOWN, 4), generator=generator),
        "scales": 0.04 + 0.08 * torch.rand((KNOWN, 3), generator=generator),
        "opacities": 0.5 + 0.45 * torch.rand(KNOWN, generator=generator),
        "features": torch.rand((KNOWN, 3), generator=generator),
    }


def oracle_views(views, background=(1.0, 1.0, 1.0)):
    images = []
    for camera in views:
        splats = rasterise(**known_gaussians(), camera=camera, backend="torch")
        images.append(torch.cat([splats.features, splats.alpha[..., None]], dim=-1).numpy())
    return ViewSet(tuple(views), np.stack(images).astype(np.float32), background, "oracle")


@pytest.fixture(scope="session")
def scene():
    """Twelve training and three validation views; a cloud of noisy points with wrong colors."""
    known = known_gaussians()
    generator = torch.Generator().manual_seed(8)
    jitter = 0.03 * torch.randn((4 * KNOWN, 3), generator=generator)
    points = known["means"].repeat(4, 1) + jitter
    return SceneInput(
        scene=BasicScene("tiny"),
        train=oracle_views(cameras(12)),
        validation=oracle_views(cameras(3, phase=1.0)),
        cloud=PointCloud(points.numpy(), np.full((4 * KNOWN, 3), 0.5, dtype=np.float32)),
        extent=3.3,
    )


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
        known=known_gaussians,
        views=oracle_views,
        psnr=psnr,
        with_cloud=with_cloud,
    )
