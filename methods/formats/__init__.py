"""File formats of plain Gaussians with spherical harmonics, which viewers of splats open."""

from pathlib import Path

from econgs_bench.datasets.errors import DataError

READ = (".ply", ".spz", ".sog")
"""Suffixes of exported files, ours and those of other programs, that can be read."""
_NOT_READ = (".glb", ".gltf", ".splat", ".ksplat", ".rad", ".lcc")


def refuse_unread(file: Path) -> None:
    """Refuse a file whose suffix is that of splats which cannot be read; any other name passes.

    Raises:
        DataError: names the formats that can be read.
    """
    if file.suffix.lower() in _NOT_READ:
        reason = f"splats in {file.suffix.lower()} are not read"
        raise DataError(file, reason, f"Convert it to one of {', '.join(READ)}, as SuperSplat does")
