"""The same scene in other units: all coordinates multiplied by a factor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.views import ViewSet


def camera_in_units(camera: Camera, units: float) -> Camera:
    """The same view of a scene whose coordinates are multiplied by ``units``."""
    matrix = camera.camera_to_world.copy()
    matrix[:3, 3] *= units
    return replace(camera, camera_to_world=matrix, near=units * camera.near)


def views_in_units(views: ViewSet, units: float) -> ViewSet:
    """Views of a scene whose coordinates are multiplied by ``units``."""
    return replace(views, cameras=tuple(camera_in_units(camera, units) for camera in views.cameras))


def cloud_in_units(cloud: PointCloud, units: float) -> PointCloud:
    """Points of a scene whose coordinates are multiplied by ``units``."""
    return PointCloud(cloud.points * np.float32(units), cloud.colors)


def scene_in_units(scene: BasicScene, units: float) -> BasicScene:
    """The definition of a scene whose coordinates are multiplied by ``units``."""
    if scene.transfer is None:
        return scene
    length = units * scene.transfer.reference_length
    return replace(scene, transfer=replace(scene.transfer, reference_length=length))
