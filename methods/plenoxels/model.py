"""A trained Plenoxels representation: rendering, composition, and the folder it is saved in."""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.bounded import array_of, json_of
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.rays import camera_rays
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.plenoxels.grid import SH, VoxelGrid, Voxels, bricks_of
from econgs_bench.methods.plenoxels.march import drawn
from econgs_bench.methods.plenoxels.spec import DEFLATE
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.fields import FieldModel
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.model import seconds

FORMAT = "econgs-bench plenoxels 1"
PER_VOXEL = 4 + 2 * SH
"""Bytes: density in single, coefficients in half precision."""
_DATE = (1980, 1, 1, 0, 0, 0)
_HEAD = 4096
"""Bytes of the description of a scene, at most."""
_MOST = 1 << 28  # vertices of a lattice


@dataclass(frozen=True, eq=False)
class VoxelScene:
    """The grid of one scene as it is stored. A brick without a density above 0 counts as empty.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        grid: the voxels; coefficients are exact in half precision.
    """

    name: str
    background: RGB
    grid: VoxelGrid

    def __post_init__(self) -> None:
        bricks = bricks_of(self.grid.links, self.grid.voxels.densities > 0.0)
        object.__setattr__(self, "grid", replace(self.grid, bricks=bricks))

    def __len__(self) -> int:
        return len(self.grid)

    def write(self, folder: Path, level: int) -> dict[str, int]:
        """Write ``<scene>.npz``; bytes by part."""
        grid = self.grid
        about = {
            "format": FORMAT,
            "scene": self.name,
            "background": list(self.background),
            "origin": list(grid.origin),
            "spacing": grid.spacing,
            "unit": grid.unit,
        }
        arrays = {
            "links": grid.links.cpu().numpy(),
            "density_data": grid.voxels.densities.cpu().numpy(),
            "sh_data": grid.voxels.colors[:, :SH].half().cpu().numpy(),
            "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
        }
        file = folder / f"{quote(self.name, safe=' ')}.npz"
        method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
        with zipfile.ZipFile(file, "w", method, compresslevel=level or None) as archive:
            for name, array in arrays.items():
                data = io.BytesIO()
                np.lib.format.write_array(data, np.ascontiguousarray(array), allow_pickle=False)
                entry = zipfile.ZipInfo(f"{name}.npy", _DATE)
                entry.compress_type = method
                archive.writestr(entry, data.getbuffer(), compresslevel=level or None)
            sizes = {one.filename.removesuffix(".npy"): one.compress_size for one in archive.infolist()}
        parts = {"links": sizes["links"], "density": sizes["density_data"], "sh": sizes["sh_data"]}
        return parts | {"metadata": file.stat().st_size - sum(parts.values())}


class VoxelModel(FieldModel[VoxelScene]):
    """Voxel grids of scenes; drawn together, their densities add and their colors mix by density."""

    method = "plenoxels"

    def drawn(
        self, scenes: Sequence[VoxelScene], camera: Camera, factors: Sequence[float]
    ) -> tuple[Tensor, Tensor]:
        """Premultiplied colors (H, W, 3) and alpha (H, W)."""
        grids = [scene.grid for scene in scenes]
        rays = camera_rays(self._in_units(camera), torch.float32).to(str(grids[0].links.device))
        colors, alpha = drawn(grids, rays, factors)
        shape = (camera.height, camera.width)
        return colors.reshape(*shape, 3), alpha.reshape(shape)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part."""
        subset = self.chosen(scenes)
        start = seconds()
        self.drawn(subset, camera, [1.0] * len(subset))
        return {"decode": 0.0, "shade": 0.0, "rasterise": seconds() - start}

    def bytes_estimate(self) -> int:
        """Bytes as published; headers and metadata add about a thousand."""
        return sum(4 * scene.grid.links.numel() + PER_VOXEL * len(scene) for scene in self._scenes.values())

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.npz`` per scene; the rate is the level of deflation, 0 (as published) to 9.

        Raises:
            Refused: another rate.
        """
        level = 0.0 if rate is None else rate
        if level not in range(10):
            raise Refused(f"{self.method} saves at levels of {DEFLATE} from 0 to 9, not at {level:g}")
        return {name: scene.write(folder, int(level)) for name, scene in self._scenes.items()}

    @classmethod
    def load(cls, folder: Path, device: str) -> VoxelModel:
        return cls(_load_scene(file, device) for file in saved_files(folder, ".npz", cls.method))


def _load_scene(file: Path, device: str) -> VoxelScene:
    try:
        with zipfile.ZipFile(file) as archive:
            about = json_of(array_of(archive, "about", np.uint8, 1, _HEAD).tobytes())
            if about["format"] != FORMAT:
                raise ValueError(f"format {about['format']!r} instead of {FORMAT!r}")
            links = array_of(archive, "links", np.int32, 3, _MOST)
            count = int((links >= 0).sum())
            if links.max(initial=-1) != count - 1:
                raise ValueError(f"links up to {links.max(initial=-1)}, of {count} vertices with one")
            densities = array_of(archive, "density_data", np.float32, 1, count)
            coefficients = array_of(archive, "sh_data", np.float16, 2, SH * len(densities))
        name, background, origin = str(about["scene"]), triple(about["background"]), triple(about["origin"])
        spacing, unit = float(about["spacing"]), float(about["unit"])
        _check(links, densities, coefficients, (*origin, *background, spacing, unit))
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(file, f"not a scene of plenoxels ({error})", "Save the model again") from error
    voxels = Voxels.zeros(len(densities), torch.zeros((), device=device))
    voxels.densities.copy_(torch.from_numpy(densities))
    voxels.colors[:, :SH] = torch.from_numpy(coefficients).to(device).float()
    placed = torch.from_numpy(links).to(device)
    return VoxelScene(name, background, VoxelGrid(placed, voxels, bricks_of(placed), origin, spacing, unit))


def _check(
    links: NDArray[Any],
    densities: NDArray[Any],
    coefficients: NDArray[Any],
    numbers: Iterable[float],
) -> None:
    *_, spacing, unit = numbers = tuple(numbers)
    if not all(map(math.isfinite, numbers)) or spacing <= 0.0 or unit <= 0.0:
        raise ValueError("a place, spacing, unit or color is out of range")
    if min(links.shape) < 2 or max(links.shape) > 4096 or links.size > _MOST:
        raise ValueError(f"a lattice of {links.shape} vertices")
    if coefficients.shape != (len(densities), SH):
        raise ValueError(f"{coefficients.shape} coefficients of {len(densities)} voxels")
    if not (np.isfinite(densities).all() and np.isfinite(coefficients).all()):
        raise ValueError("a voxel holds NaN or infinite values")
    used = np.sort(links[links >= 0])
    if not np.array_equal(used, np.arange(len(densities))):
        raise ValueError("links do not name every voxel once")
