"""PLY of 3DGS, every number in float32: the file that every viewer opens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from econgs_bench.methods.formats.gaussians import Contents, checked, scene_of, tables
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.gaussian_splatting.ply import ANTIALIASED, read_any, write_ply

SUFFIX = ".ply"


def write(file: Path, scene: SceneGaussians, *, antialiased: bool = False) -> Mapping[str, int]:
    """Write a scene; bytes by part. See :class:`.methods.formats.gaussians.Format`."""
    rows = scene_of(tables(scene), scene.name, scene.background, 3).rows()
    return write_ply(file, rows, comments=(ANTIALIASED,) if antialiased else ())


def read(file: Path) -> Contents:
    """Read a scene, of this writer or of another trainer.

    Raises:
        DataError: the file is missing, damaged or of another kind.
    """

    def parsed() -> Contents:
        rows, degree, antialiased = read_any(file)
        scene = SceneGaussians.from_rows("", (0.0, 0.0, 0.0), degree, rows, "cpu")
        return Contents(tables(scene), antialiased)

    return checked(file, "PLY", parsed)
