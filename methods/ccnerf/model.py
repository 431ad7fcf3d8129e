"""A trained CCNeRF-CP representation: rendering, and the folder it is saved in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.rays import camera_rays
from econgs_bench.methods.ccnerf.field import BANDS, Factors, drawn
from econgs_bench.methods.ccnerf.lines import Lines
from econgs_bench.methods.ccnerf.rays import Region
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.fields import FieldModel
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.model import seconds
from econgs_bench.methods.shared.sealed import read_tensors, write_tensors

FORMAT = "econgs-bench ccnerf 1"
SUFFIX = ".safetensors"
_AXES = "xyz"


class CpModel(FieldModel[Factors]):
    """Scenes of factors, drawn by samples along rays."""

    method = "ccnerf"

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame: densities and weights ("decode"), colors ("shade")."""
        subset = self.chosen(scenes)
        times = {"decode": 0.0, "shade": 0.0, "rasterise": 0.0}
        self._timed(subset, camera, [1.0] * len(subset), times)
        return times

    def drawn(
        self, scenes: Sequence[Factors], camera: Camera, factors: Sequence[float]
    ) -> tuple[Tensor, Tensor]:
        """Premultiplied colors (H, W, 3) and alpha (H, W)."""
        return self._timed(scenes, camera, factors, {})

    def _timed(
        self, scenes: Sequence[Factors], camera: Camera, factors: Sequence[float], times: dict[str, float]
    ) -> tuple[Tensor, Tensor]:
        """The same; seconds are added to ``times``."""
        last = seconds()

        def clock(part: str) -> None:
            nonlocal last
            now = seconds()
            times[part] = times.get(part, 0.0) + now - last
            last = now

        with torch.inference_mode():
            rays = camera_rays(self._in_units(camera))
            colors, alpha = drawn(scenes, factors, rays, clock)
            size = camera.height, camera.width
            return colors.reshape(*size, 3), alpha.reshape(size)

    def bytes_estimate(self) -> int:
        """Bytes of factors, coefficients and mask; metadata add some hundred."""
        return sum(sum(map(_bytes, _tensors(scene).values())) for scene in self._scenes.values())

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.safetensors`` per scene.

        Args:
            folder: where to.
            rate: groups of color ranks to keep, at least one rank; parts of a group are possible.

        Raises:
            Refused: there are not as many.
        """
        return {name: _write(_at(scene, rate), folder) for name, scene in self._scenes.items()}

    @classmethod
    def load(cls, folder: Path, device: str) -> CpModel:
        return cls(_read(file, device) for file in saved_files(folder, SUFFIX, "ccnerf"))


def _at(scene: Factors, rate: float | None) -> Factors:
    if rate is None:
        return scene
    there = scene.color[0].shape[1]
    ranks = round(rate * scene.group) if math.isfinite(rate) else 0
    if not 1 <= ranks <= there:
        raise Refused(
            f"ccnerf has {there / scene.group:g} groups of {scene.group} color ranks of scene "
            f"{scene.name!r}, not {rate:g}"
        )
    return scene.truncated(ranks)


def _tensors(scene: Factors) -> dict[str, Tensor]:
    """Name -> tensor as stored."""
    lines = {"density": scene.density, "color": scene.color}
    tensors = {
        f"{part}.{axis}": line.detach().float().cpu().contiguous()
        for part, three in lines.items()
        for axis, line in zip(_AXES, three, strict=True)
    }
    tensors["harmonics"] = scene.harmonics.detach().float().cpu().contiguous()
    tensors["mask"] = torch.from_numpy(np.packbits(scene.region.cells.numpy() > 0))
    return tensors


def _write(scene: Factors, folder: Path) -> dict[str, int]:
    tensors = _tensors(scene)
    about = {
        "format": FORMAT,
        "scene": scene.name,
        "background": list(scene.background),
        "low": list(scene.region.low),
        "high": list(scene.region.high),
        "cells": list(scene.region.cells.shape),
        "group": scene.group,
        "spacing": scene.spacing,
        "threshold": scene.threshold,
    }
    sizes = write_tensors(folder / f"{quote(scene.name, safe=' ')}{SUFFIX}", tensors, about)
    parts: dict[str, int] = {}
    for name, size in sizes.items():
        part = name.partition(".")[0]
        parts[part] = parts.get(part, 0) + size
    return parts


def _bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _read(file: Path, device: str) -> Factors:
    try:
        about, tensors = read_tensors(file, FORMAT)
        return _checked(about, tensors, device)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DataError(file, f"not a scene of ccnerf ({error})", "Save the model again") from error


def _checked(facts: Mapping[str, Any], tensors: Mapping[str, Tensor], device: str) -> Factors:
    """A scene from its metadata and tensors.

    Raises:
        ValueError, KeyError, TypeError: they do not fit.
    """
    lines: dict[str, Lines] = {}
    for part in ("density", "color"):
        x, y, z = (_numbers(tensors, f"{part}.{axis}") for axis in _AXES)
        if any(one.ndim != 2 or len(one) < 2 or one.shape[1] != x.shape[1] for one in (x, y, z)):
            raise ValueError(f"{part} has no lines of one number of ranks")
        lines[part] = x.to(device), y.to(device), z.to(device)
    if [len(one) for one in lines["density"]] != [len(one) for one in lines["color"]]:
        raise ValueError("lines of density and color have different lengths")
    harmonics = _numbers(tensors, "harmonics")
    if harmonics.shape != (BANDS, 3, lines["color"][0].shape[1]):
        raise ValueError("no SH coefficients for each color rank")
    low, high = triple(facts["low"]), triple(facts["high"])
    spacing, threshold = float(facts["spacing"]), float(facts["threshold"])
    if not all(math.isfinite(b - a) and b > a for a, b in zip(low, high, strict=True)):
        raise ValueError(f"a box from {low} to {high}")
    if not (0.0 < spacing <= 100.0 and 0.0 <= threshold < 1.0):
        raise ValueError(f"spacing {spacing}, threshold {threshold}")
    shape = tuple(int(n) for n in triple(facts["cells"]))
    mask = tensors["mask"]
    count = math.prod(shape)
    if min(shape) < 1 or mask.dtype != torch.uint8 or mask.shape != (-(-count // 8),):
        raise ValueError(f"no mask of {shape} cells")
    cells = torch.from_numpy(np.unpackbits(mask.numpy(), count=count).reshape(shape))
    return Factors(
        name=str(facts["scene"]),
        background=triple(facts["background"]),
        region=Region(low, high, cells),
        density=lines["density"],
        color=lines["color"],
        harmonics=harmonics.to(device),
        group=max(1, int(facts["group"])),
        spacing=spacing,
        threshold=threshold,
    )


def _numbers(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    values = tensors[name]
    if values.dtype != torch.float32 or not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} is no table of finite numbers")
    return values
