"""PLY of 3DGS, every number in float32: the file that every viewer opens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from econgs_bench.methods.formats.gaussians import Tables, checked, scene_of, tables
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.gaussian_splatting.ply import read_ply, write_ply

SUFFIX = ".ply"


def write(file: Path, scene: SceneGaussians) -> Mapping[str, int]:
    """Write a scene; bytes by part."""
    return write_ply(file, scene_of(tables(scene), scene.name, scene.background, 3).rows())


def read(file: Path) -> Tables:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
    """

    def parsed() -> Tables:
        return tables(SceneGaussians.from_rows("", (0.0, 0.0, 0.0), 3, read_ply(file), "cpu"))

    return checked(file, "PLY", parsed)
