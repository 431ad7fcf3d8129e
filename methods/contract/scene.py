"""The contract kit's scenes: a few Gaussians, rendered by the torch oracle, and a volume of them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import BasicScene, Isosurface
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.views import ViewSet
from econgs_bench.datasets.volume import Volume
from econgs_bench.econgs.splat.rasterise import rasterise
from econgs_bench.methods.interface import SceneInput

SIZE = 32
COUNT = 24
_DISTANCE = 3.0
_GOLDEN = 2.399963  # radians between neighbours on a spiral
_BUMPS = (
    Bump("outer", 0.1, 0.2, 0.3, 0.5, (0.2, 0.5, 0.9), 0.2),
    Bump("inner", 0.4, 0.6, 1.0, 1.0, (0.9, 0.4, 0.1), 0.7),
)
_SHOWN: dict[str, Any] = {
    "transfer": TransferFunction("tiny", _BUMPS, 0.05),
    "isosurfaces": (
        Isosurface("outer", 0.2, (0.2, 0.5, 0.9), 0.4),
        Isosurface("inner", 0.5, (0.9, 0.4, 0.1)),
    ),
}
"""What scenes show of the tiny volume."""


def look_at(position: tuple[float, float, float], size: int = SIZE, fov: float = 0.5) -> Camera:
    """A camera at ``position`` that looks at the origin."""
    eye = np.asarray(position, dtype=float)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return Camera.with_fov(pose, fov, size, size)


def away(camera: Camera) -> Camera:
    """The same place, looking the other way."""
    return replace(camera, camera_to_world=camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))


def cameras(count: int, phase: float = 0.0) -> tuple[Camera, ...]:
    """Cameras on a spiral around the origin."""
    spiral = []
    for i in range(count):
        z = 0.8 * (2.0 * (i + 0.5) / count - 1.0)
        turn, radius = _GOLDEN * i + phase, math.sqrt(1.0 - z * z)
        direction = (radius * math.cos(turn), radius * math.sin(turn), z)
        spiral.append(look_at((_DISTANCE * direction[0], _DISTANCE * direction[1], _DISTANCE * direction[2])))
    return tuple(spiral)


def tiny_gaussians(turn: float = 0.0) -> dict[str, torch.Tensor]:
    """Arguments of ``rasterise``: a cloud of Gaussians, turned about z by an angle in radians."""
    generator = torch.Generator().manual_seed(7)
    means = (torch.rand((COUNT, 3), generator=generator) - 0.5) * 0.9
    c, s = math.cos(turn), math.sin(turn)
    return {
        "means": means @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]),
        "quats": torch.randn((COUNT, 4), generator=generator),
        "scales": 0.04 + 0.08 * torch.rand((COUNT, 3), generator=generator),
        "opacities": 0.5 + 0.45 * torch.rand(COUNT, generator=generator),
        "features": torch.rand((COUNT, 3), generator=generator),
    }


def tiny_volume(turn: float = 0.0, size: int = 24) -> Volume:
    """Summed densities of the tiny Gaussians on a grid over the unit box."""
    gaussians = tiny_gaussians(turn)
    axis = torch.linspace(-0.5, 0.5, size)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    places = torch.stack([x, y, z], dim=-1)
    values = torch.zeros(size, size, size)
    for mean, scales, opacity in zip(
        gaussians["means"], gaussians["scales"], gaussians["opacities"], strict=True
    ):
        squared = ((places - mean) / scales.mean()).square().sum(-1)
        values += opacity * torch.exp(-0.5 * squared)
    return Volume("density", values.numpy(), (1.0, 1.0, 1.0), (0.0, float(values.max())), "contract")


def _swapped(scene: BasicScene) -> BasicScene:
    """The scene with its two colors in the other order."""
    if scene.transfer is None:
        one, two = scene.isosurfaces
        return replace(scene, isosurfaces=(replace(one, color=two.color), replace(two, color=one.color)))
    low, high = scene.transfer.bumps
    bumps = (replace(low, color=high.color), replace(high, color=low.color))
    return replace(scene, transfer=replace(scene.transfer, bumps=bumps))


def tiny_scene(
    name: str,
    turn: float = 0.0,
    volume: Literal["transfer", "isosurfaces"] | None = None,
    swapped: bool = False,
) -> SceneInput:
    """Twelve training and three validation views of 32 x 32 pixels; a cloud of noisy gray points.

    Args:
        name: the scene's name.
        turn: angle in radians about z.
        volume: what is shown of the tiny volume; None: the Gaussians, of which there is no volume.
        swapped: the two colors of what is shown of the volume change places.
    """
    gaussians = tiny_gaussians(turn)
    scene = BasicScene(name)
    if volume is not None:
        field = tiny_volume(turn)
        scene = BasicScene(name, field.name, **{volume: _SHOWN[volume]})
        if swapped:
            scene = _swapped(scene)
        marcher, layers = ReferenceMarcher(field, dtype=torch.float32), (Layer.of(scene, field),)

    def image(camera: Camera) -> NDArray[np.float32]:
        splats = rasterise(**gaussians, camera=camera, backend="torch")  # type: ignore[arg-type]
        picture: NDArray[np.float32] = torch.cat([splats.features, splats.alpha[..., None]], dim=-1).numpy()
        return picture

    def views(path: tuple[Camera, ...]) -> ViewSet:
        images = (
            np.stack([image(camera) for camera in path]) if volume is None else marcher.compose(path, layers)
        )
        return ViewSet(path, images.astype(np.float32), (1.0, 1.0, 1.0), "contract")

    jitter = 0.03 * torch.randn((4 * COUNT, 3), generator=torch.Generator().manual_seed(8))
    points = (gaussians["means"].repeat(4, 1) + jitter).numpy()
    return SceneInput(
        scene=scene,
        train=views(cameras(12)),
        validation=views(cameras(3, phase=1.0)),
        cloud=PointCloud(points, np.full_like(points, 0.5)),
        extent=1.1 * _DISTANCE,
        volume=partial(tiny_volume, turn) if volume else None,
    )
