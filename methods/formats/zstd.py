"""The PLY of 3DGS in a frame of Zstandard: without loss, for a comparison. `zstd -d` makes it a PLY again."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import imagecodecs

from econgs_bench.methods.formats import ply
from econgs_bench.methods.formats.gaussians import Contents, checked
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.shared.decoders import decoded

SUFFIX = ".ply.zst"
LEVEL = 19


def write(file: Path, scene: SceneGaussians, *, antialiased: bool = False) -> Mapping[str, int]:
    """Write a scene; bytes by part. See :class:`.methods.formats.gaussians.Format`."""
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, "scene.ply")
        ply.write(plain, scene, antialiased=antialiased)
        return {"file": file.write_bytes(imagecodecs.zstd_encode(plain.read_bytes(), level=LEVEL))}


def read(file: Path) -> Contents:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
    """

    def parsed() -> Contents:
        data = decoded("zstd", file.read_bytes())["bytes"].tobytes()
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder, "scene.ply")
            plain.write_bytes(data)
            return ply.read(plain)

    return checked(file, "PLY in Zstandard", parsed)
