"""SPZ of Niantic, versions 3 and 4, by the library gsply; its axes point right, up and back, not as a PLY's.

gsply neither turns axes nor rounds spherical harmonics as the format's own tool does: both are done here.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from econgs_bench.methods.formats.gaussians import (
    COEFFICIENTS,
    RIGHT_UP_BACK,
    SHAPES,
    Contents,
    checked,
    degree_of,
    tables,
    turned,
)
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.decoders import check_count, decoded

SUFFIX = ".spz"
VERSION = 3
"""Written by default; Spark does not read 4."""
ANTIALIASED = 0x1
"""Flag of the header: the Gaussians are meant for viewers that compensate opacities for their filter."""
BITS = (5, 4, 4)
"""Of coefficients of degree 1, 2 and 3, as the format's own tool rounds by default."""
FINEST = (8, 8, 8)
"""The most that the format can hold."""
_HEAD, _FLAGS = struct.Struct("<4sIIBBBB"), 14
"""Magic, version, Gaussians, degree, binary places, flags, streams (0 before 4); place of the flags."""
_LEVEL = 12
_FRACTION = 12
"""Binary places of positions, as of the format's own tool; more in scenes below 1, fewer beyond ±2048."""


def write(
    file: Path,
    scene: SceneGaussians,
    bits: tuple[int, int, int] = BITS,
    version: int = VERSION,
    *,
    antialiased: bool = False,
) -> Mapping[str, int]:
    """Write a scene; bytes by part.

    Args:
        file: where to.
        scene: its Gaussians.
        bits: of coefficients of degree 1, 2 and 3, at most 8.
        version: 3 (one stream of gzip) or 4 (a frame of Zstandard for each table).
        antialiased: whether to say that viewers shall compensate for their filter.

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
    gsply.write_spz(file, gaussians, version=3, fractional_bits=fraction_bits(values["means"]))
    # Compressed anew: gsply puts the time into the file, and its bytes depend on the packages that are there.
    data = bytearray(gzip.decompress(file.read_bytes()))
    data[_FLAGS] |= ANTIALIASED * antialiased
    whole = gzip.compress(data, compresslevel=9, mtime=0) if version == 3 else _version_4(bytes(data))
    return {"file": file.write_bytes(whole)}


def read(file: Path) -> Contents:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
        Refused: gsply is not installed.
    """

    def parsed() -> Contents:
        data = file.read_bytes()
        bare = data[:4] == b"NGSP"
        found = decoded("spz", _version_3(data) if bare else data)
        rest = np.zeros((len(found["means"]), *SHAPES["sh_rest"]), np.float32)
        rest[:, : found["sh_rest"].shape[1]] = found["sh_rest"]
        # gsply drops the flag, which lies in the first bytes: of the file, or of its stream of gzip.
        head = data if bare else zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, _HEAD.size)
        marked = bool(head[_FLAGS] & ANTIALIASED)
        return Contents(turned({**found, "sh_rest": rest}, RIGHT_UP_BACK), marked)

    return checked(file, "SPZ", parsed)


def _tables(count: int, degree: int) -> list[int]:
    """Bytes of the tables that are not empty, in their order."""
    sizes = (9 * count, count, 3 * count, 3 * count, 4 * count, 3 * COEFFICIENTS[degree] * count)
    return [size for size in sizes if size]


def _version_4(data: bytes) -> bytes:
    """Version 4 of the bytes within the gzip of version 3: the same tables, each in a frame of its own."""
    magic, _, count, *about, _ = _HEAD.unpack_from(data)
    start, frames, sizes = _HEAD.size, [], []
    for size in _tables(count, about[0]):
        frames.append(bytes(imagecodecs.zstd_encode(data[start : start + size], level=_LEVEL)))
        sizes += [len(frames[-1]), size]
        start += size
    head = _HEAD.pack(magic, 4, count, *about, len(frames)) + struct.pack("<I12x", _HEAD.size + 16)
    return head + struct.pack(f"<{len(sizes)}Q", *sizes) + b"".join(frames)


def _version_3(data: bytes) -> bytes:
    """Inverse of :func:`_version_4`, with the gzip.

    Raises:
        ValueError: the file is damaged.
    """
    magic, version, count, degree, fraction, flags, streams = _HEAD.unpack_from(data)
    check_count(count, len(data))
    sizes = _tables(count, degree) if degree in COEFFICIENTS else []
    (contents,) = struct.unpack_from("<I", data, _HEAD.size)
    stored = struct.unpack_from(f"<{2 * len(sizes)}Q", data, contents)
    start = contents + 8 * len(stored)
    if (
        version != 4
        or streams != len(sizes)
        or list(stored[1::2]) != sizes
        or start + sum(stored[::2]) > len(data)
    ):
        raise ValueError("no SPZ of version 4 with tables of the sizes that its header says")
    tables = [_HEAD.pack(magic, 3, count, degree, fraction, flags, 0)]
    for length in stored[::2]:
        tables.append(decoded("zstd", data[start : start + length])["bytes"].tobytes())
        start += length
    return gzip.compress(b"".join(tables), compresslevel=1, mtime=0)


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
