"""Where a scene can be, by its training views: the visual hull of their alpha."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from econgs_bench.datasets.camera import looked_at
from econgs_bench.methods.interface import SceneInput
from econgs_bench.methods.plenoxels.grid import VoxelGrid, Voxels, bricks_of, lattice, links_of, occupied

CELLS = 64
"""Cells along the cube in which a hull is looked for first."""
LEAST_ALPHA = 0.5 / 255.0
"""Less is nothing."""
_NEAREST = 0.5
"""Depth from which a view is asked, as a share of the distance of its camera."""


class Hull:
    """The visual hull of a scene.

    Args:
        scene: with at least one training view.

    Attributes:
        middle: (3,) centre of what the cameras look at.
        half: half side of the cube around it that they see.
    """

    def __init__(self, scene: SceneInput) -> None:
        self.cameras = scene.train.cameras
        self.masks = torch.from_numpy(scene.train.images)[..., 3] > LEAST_ALPHA
        places = np.stack([camera.position for camera in self.cameras])
        axes = np.stack([camera.camera_to_world[:3, 2] for camera in self.cameras])
        self.middle = looked_at(self.cameras)
        if float(((self.middle - places) * axes).sum(axis=1).min()) < 1e-3 * scene.extent:
            # One camera, or parallel ones, do not tell how far away they look.
            self.middle = np.mean(scene.cloud.points, axis=0, dtype=np.float64)
        self.distances = np.linalg.norm(places - self.middle, axis=1)
        angles = [max(one.width / one.fx, one.height / one.fy) / 2.0 for one in self.cameras]
        self.half = float((self.distances * angles).max()) or scene.extent

    def pixels(self, radius: float, view: int) -> int:
        """Pixels that a sphere of that radius spans in a view, on either side of its middle."""
        focal = max(self.cameras[view].fx, self.cameras[view].fy)
        return math.ceil(radius * focal / (_NEAREST * float(self.distances[view]) + 1e-9)) + 1

    def widened(self, radius: float, view: int) -> Tensor:
        """(H, W) bool: pixels in which a sphere of that radius may show that touches what is there."""
        height, width = self.masks.shape[1:]
        pixels = min(self.pixels(radius, view), max(height, width))
        mask = self.masks[view].float()[None, None]
        for size in ((2 * pixels + 1, 1), (1, 2 * pixels + 1)):
            mask = functional.max_pool2d(mask, size, 1, (size[0] // 2, size[1] // 2))
        return mask[0, 0] > 0

    def holds(self, points: Tensor, radius: float) -> Tensor:
        """Whether no view is empty around each of the points (M, 3), and one has it in sight."""
        kept = torch.ones(len(points), dtype=torch.bool)
        seen = torch.zeros(len(points), dtype=torch.bool)
        for view, camera in enumerate(self.cameras):
            rows = kept.nonzero()[:, 0]
            pose = torch.from_numpy(camera.world_to_camera).float()
            local = points[rows] @ pose[:3, :3].T + pose[:3, 3]
            depth = local[:, 2]
            ahead = depth > _NEAREST * self.distances[view]
            safe = torch.where(ahead, depth, 1.0)
            column = (local[:, 0] / safe * camera.fx + camera.cx).floor().long()
            row = (local[:, 1] / safe * camera.fy + camera.cy).floor().long()
            inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            there = rows[inside]
            seen[there] = True
            kept[there] = self.widened(radius, view)[row[inside], column[inside]]
        return kept & seen


def first_grid(scene: SceneInput, hull: Hull, longest: int, start: str, density: float) -> VoxelGrid:
    """The grid that a fit starts from.

    Args:
        scene: with its views.
        hull: of the scene.
        longest: vertices along the longest side.
        start: "hull", or "box" for voxels everywhere in its bounding box.
        density: of every voxel.
    """
    cell = 2.0 * hull.half / CELLS
    corner = torch.from_numpy(hull.middle).float() - hull.half
    centres = corner + (_vertices((CELLS, CELLS, CELLS)) + 0.5) * cell
    held = hull.holds(centres, 0.5 * math.sqrt(3.0) * cell)
    there = centres[held] if bool(held.any()) else centres
    low, high = there.amin(0) - cell, there.amax(0) + cell
    sides = (high - low).tolist()
    spacing = max(sides) / (longest - 1)
    size = lattice(sides, spacing)
    inside = torch.ones(size[::-1], dtype=torch.bool)
    if not bool(held.any()):
        inside[:] = False
    elif start == "hull":
        places = low + _vertices(size) * spacing
        inside = hull.holds(places, math.sqrt(3.0) * spacing).reshape(inside.shape)
    links = links_of(inside)
    voxels = Voxels.zeros(len(occupied(links)), torch.zeros(()))
    voxels.densities.fill_(density)
    x, y, z = low.tolist()
    return VoxelGrid(links, voxels, bricks_of(links), (x, y, z), spacing, 0.5 * max(sides))


def _vertices(size: tuple[int, int, int]) -> Tensor:
    """(nx · ny · nz, 3) indices x, y, z in the order of a flattened lattice."""
    x, y, z = (torch.arange(n, dtype=torch.float32) for n in size)
    grid = torch.meshgrid(z, y, x, indexing="ij")
    return torch.stack(grid[::-1], dim=-1).reshape(-1, 3)
