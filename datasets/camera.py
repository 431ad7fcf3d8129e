"""The pinhole camera that every renderer and every method here shares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEAR = 0.05
"""Near plane / distance of the camera: 0.2 at the 4 units of NeRF's Blender scenes, as 3DGS has it."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    Pixel centres lie at half-integers: pixel (column u, row v) is sampled at (u + 0.5, v + 0.5).

    Attributes:
        camera_to_world: (4, 4) float64 rigid transform, last row 0 0 0 1.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels, measured from the top-left image corner.
        width, height: image size in pixels.
        name: identifier of the view within its set (:func:`.datasets.pictures.named` for views on disk).
        near: least depth at which Gaussians are drawn, in scene units.
    """

    camera_to_world: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    name: str = ""
    near: float = 0.2

    @classmethod
    def with_fov(
        cls,
        camera_to_world: NDArray[np.float64],
        fov_x: float,
        width: int,
        height: int,
        name: str = "",
        near: float = 0.2,
    ) -> Camera:
        """A camera with square pixels, centred principal point and horizontal field of view in radians."""
        focal = 0.5 * width / math.tan(0.5 * fov_x)
        matrix = np.asarray(camera_to_world, dtype=np.float64)
        return cls(matrix, focal, focal, 0.5 * width, 0.5 * height, width, height, name, near)

    @property
    def fov_x(self) -> float:
        """Horizontal field of view in radians (of a centred principal point)."""
        return 2.0 * math.atan(0.5 * self.width / self.fx)

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) camera centre in world space."""
        return self.camera_to_world[:3, 3]

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """(4, 4) inverse of the rigid ``camera_to_world``."""
        rotation = self.camera_to_world[:3, :3].T
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ self.camera_to_world[:3, 3]
        return matrix

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )

    def sees(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) whether each of (n, 3) points in world space is beyond the near plane and in the picture."""
        x, y, z = ((points - self.position) @ self.camera_to_world[:3, :3]).T
        u, v = self.fx * x + self.cx * z, self.fy * y + self.cy * z
        inside = (u >= 0.0) & (u <= self.width * z) & (v >= 0.0) & (v <= self.height * z)
        return np.asarray(inside & (z > self.near))

    def rays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World-space rays through all pixel centres.

        Returns:
            origin (3,) and unit directions (height, width, 3), float64.
        """
        return self.rays_through(np.arange(self.width) + 0.5, (np.arange(self.height) + 0.5)[:, None])

    def rays_through(
        self, x: NDArray[Any], y: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World-space rays through points of the picture.

        Args:
            x: pixels from the left border.
            y: pixels from the upper border; the two broadcast to (...).

        Returns:
            origin (3,) and unit directions (..., 3), float64.
        """
        u, v = (np.asarray(x, dtype=np.float64) - self.cx) / self.fx, (y - self.cy) / self.fy
        grid = np.stack(np.broadcast_arrays(u, v, 1.0), axis=-1)
        directions = grid @ self.camera_to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return self.position, directions


def rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """(3, 3) rotation by an angle in radians around a unit vector (3,), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def with_near_planes(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Cameras around an object, their near planes at :data:`NEAR` of their mean distance from the middle.

    Cameras that all stand in one place keep theirs.
    """
    places = np.stack([camera.position for camera in cameras])
    distance = float(np.linalg.norm(places - places.mean(axis=0), axis=1).mean())
    if distance == 0.0:
        return tuple(cameras)
    return tuple(replace(camera, near=NEAR * distance) for camera in cameras)


def pixel_size(cameras: Sequence[Camera]) -> float:
    """Size of a pixel at the point that cameras look at: mean over cameras, scene units; 0 for one camera."""
    places = np.stack([camera.position for camera in cameras])
    sizes = np.linalg.norm(places - looked_at(cameras), axis=1) / [camera.fx for camera in cameras]
    return float(sizes.mean())


def looked_at(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(3,) point nearest to all optical axes; of parallel axes, the middle of the cameras."""
    places = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = places.mean(axis=0)
    offset = (across @ (places - middle)[:, :, None]).sum(axis=0)[:, 0]
    point: NDArray[np.float64] = middle + np.linalg.lstsq(across.sum(axis=0), offset, rcond=1e-6)[0]
    return point
