"""SPZ of Niantic, version 3, by the library gsply; its axes point right, up and back, those of a PLY do not.

gsply neither turns axes nor rounds spherical harmonics as the format's own tool does: both are done here.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.methods.formats.gaussians import (
    COEFFICIENTS,
    RIGHT_UP_BACK,
    SHAPES,
    Tables,
    checked,
    degree_of,
    tables,
    turned,
)
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.decoders import decoded

SUFFIX = ".spz"
VERSION = 3  # viewers of today refuse 4
BITS = (5, 4, 4)
"""Of coefficients of degree 1, 2 and 3, as the format's own tool rounds by default."""
FINEST = (8, 8, 8)
"""The most that the format can hold."""
_FRACTION = 12
"""Binary places of positions, as of the format's own tool; more in scenes below 1, fewer beyond ±2048."""


def write(file: Path, scene: SceneGaussians, bits: tuple[int, int, int] = BITS) -> Mapping[str, int]:
    """Write a scene; bytes by part.

    Args:
        file: where to.
        scene: its Gaussians.
        bits: of coefficients of degree 1, 2 and 3, at most 8.

    Raises:
        Refused: gsply is not installed.
    """
    values, degree = tables(scene, RIGHT_UP_BACK), degree_of(scene)
    gsply = _library()
    gaussians = gsply.GSData.from_arrays(
        means=values["means"],
        scales=values["log_scales"],
        quats=values["quats"],
        opacities=values["logits"],
        sh0=values["sh_dc"][:, 0],
        shN=rounded(values["sh_rest"], bits)[:, : COEFFICIENTS[degree]] if degree and len(scene) else None,
        format="ply",
    )
    gsply.write_spz(file, gaussians, version=VERSION, fractional_bits=fraction_bits(values["means"]))
    # Compressed anew: gsply puts the time into the file, and its bytes depend on the packages that are there.
    data = gzip.compress(gzip.decompress(file.read_bytes()), compresslevel=9, mtime=0)
    return {"file": file.write_bytes(data)}


def read(file: Path) -> Tables:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
        Refused: gsply is not installed.
    """

    def parsed() -> Tables:
        found = decoded("spz", file.read_bytes())
        rest = np.zeros((len(found["means"]), *SHAPES["sh_rest"]), np.float32)
        rest[:, : found["sh_rest"].shape[1]] = found["sh_rest"]
        return turned({**found, "sh_rest": rest}, RIGHT_UP_BACK)

    return checked(file, "SPZ", parsed)


def rounded(rest: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
    """(N, 15, 3) coefficients at the middles of 2^bits cells of ±1, which the format holds exactly."""
    values = np.empty_like(rest)
    for degree, many in enumerate(bits, 1):
        part = slice(COEFFICIENTS[degree - 1], COEFFICIENTS[degree])
        step = 2.0 ** (1 - many)
        values[:, part] = np.clip(np.rint(rest[:, part] / step) * step, -1.0, 1.0 - 2.0**-7)
    return values


def fraction_bits(means: np.ndarray) -> int:
    """Binary places of positions, which are whole numbers of 24 bits: 1 to 23."""
    size = int(np.frexp(np.abs(means).max(initial=0.0))[1])
    return max(1, min(22 - size, max(_FRACTION, _FRACTION - size), 23))


def _library() -> Any:
    try:
        import gsply
    except ImportError as error:
        remedy = "SPZ needs the package gsply: pip install 'econgs-bench[rivals]'"
        raise Refused(remedy) from error
    return gsply
