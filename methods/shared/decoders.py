"""What libraries of others decode for the methods: streams of zfp, SZ3, Draco, SPZ, WebP and Zstandard.

A damaged or hostile stream can make such a library read beyond its memory, allocate without bound or never
end. So its header is compared with what the file around it says before the library gets it, and the library
runs in a process of its own. A worker of a run (:mod:`.bench.run.worker`) is such a process already and
decodes in itself, so that the times of loading that are measured are those of the codec.

A decoder takes the bytes and returns arrays by name, so that it can run in either place.
"""

from __future__ import annotations

import math
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import gunzipped, room
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.interface import Refused

Arrays = dict[str, NDArray[Any]]
_MISSING = "{} needs the package {}: pip install 'econgs-bench[rivals]'"
_PACKAGES = {"sz3": ("sz3", "pysz"), "draco": ("Draco", "DracoPy"), "spz": ("SPZ", "gsply")}
_FLOAT = 4

_here: ContextVar[bool] = ContextVar("here", default=False)


def decode_here() -> None:
    """Decode in this process from now on: it is one that others watch, and its end ends nothing else."""
    _here.set(True)


@contextmanager
def own_streams() -> Iterator[None]:
    """Decode in this process what it has just encoded."""
    before = _here.set(True)
    try:
        yield
    finally:
        _here.reset(before)


def decoded(codec: str, data: bytes, **arguments: Any) -> Arrays:
    """Arrays of a stream.

    Args:
        codec: name of a decoder of this module.
        data: the stream.
        arguments: of the decoder; JSON values.

    Raises:
        ValueError: the stream is damaged, or is none of that size.
        Refused: a package is missing.
    """
    if codec in _PACKAGES and find_spec(_PACKAGES[codec][1]) is None:
        raise Refused(_MISSING.format(*_PACKAGES[codec]))
    needed = _CHECKS[codec](data, **arguments)
    if _here.get():
        try:
            return _DECODERS[codec](data, **arguments)
        except (Refused, ImportError):
            raise
        except Exception as error:  # libraries raise what they like for damaged data
            raise ValueError(f"its stream is damaged ({type(error).__name__}: {error})") from error
    from econgs_bench.datasets.readers.sandbox import Sandbox

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "stream")
        path.write_bytes(data)
        try:
            child = Sandbox(path, "decoding", needed=needed)
            request = {"function": f"{__name__}:decode_{codec}", "arguments": arguments}
            return child.ask(**request)[1]
        except DataError as error:
            raise ValueError(f"its stream {error.reason}") from error


# --------------------------------------------------------------------------- grids

_ZFP_MAGIC = b"zfp"
_ZFP_FLOAT, _ZFP_AXES = 2, 3
_ZFP_HEAD, _ZFP_LONG = 96, 52
"""Bits of its header, and those that its longer form has more."""
_ZFP_RATES, _ZFP_ACCURACIES, _ZFP_OTHER = range(2048), range(2177, 4095), 4095
"""Codes of modes: bits of a block less one, exponents of the tolerance, and a form of 64 bits."""
_ZFP_MOST = 16_658
"""Bits that a block takes at most (ZFP_MAX_BITS)."""


def _zfp_head(data: bytes) -> tuple[tuple[int, int, int], int]:
    """Shape (nz, ny, nx), and bits of a block of fixed rate (0: of fixed accuracy), of a header of zfp.

    Its parts, from the lowest bit on: magic number (32 bits), type less one (2), axes less one (2), nx, ny
    and nz less one (16 each), mode (12 or 64).

    Raises:
        ValueError: it is of another type or number of axes, or of a mode that no model has.
    """
    bits = int.from_bytes(data[:20], "little")
    kind, axes = bits >> 32 & 3, bits >> 34 & 3
    if 8 * len(data) < _ZFP_HEAD or data[:3] != _ZFP_MAGIC or (kind, axes) != (_ZFP_FLOAT, _ZFP_AXES - 1):
        raise ValueError("no stream of zfp with single precision and three axes")
    nx, ny, nz = ((bits >> 36 + 16 * axis & 0xFFFF) + 1 for axis in range(3))
    mode = bits >> 84 & 0xFFF
    if mode == _ZFP_OTHER:
        least, most = (bits >> 96 & 0x7FFF) + 1, (bits >> 111 & 0x7FFF) + 1
        mode = most - 1 if least == most else -1
    elif mode in _ZFP_ACCURACIES:
        return (nz, ny, nx), 0
    elif mode not in _ZFP_RATES:
        mode = -1
    if mode < 0:
        raise ValueError("a stream of zfp of neither fixed accuracy nor fixed rate")
    return (nz, ny, nx), mode + 1


def _check_zfp(data: bytes, shape: Sequence[int]) -> int:
    stored, rate = _zfp_head(data)
    if stored != tuple(shape):
        raise ValueError(f"a grid of {stored} in a file of {tuple(shape)}")
    blocks = math.prod(-(-n // 4) for n in stored)
    head = _ZFP_HEAD + (_ZFP_LONG if rate > len(_ZFP_RATES) else 0)
    if head + blocks * max(rate, 1) > 8 * len(data):
        raise ValueError(f"{len(data)} bytes are too few for {blocks} blocks of zfp")
    return _in_memory(shape)


def decode_zfp(data: bytes, shape: Sequence[int]) -> Arrays:
    """Values (nz, ny, nx) of zfp.

    The library looks for no end of a stream: behind it are zeros enough for a block that was cut, and for a
    bit of each block after it.
    """
    import imagecodecs

    blocks = math.prod(-(-n // 4) for n in shape)
    padded = data + bytes(_ZFP_MOST // 8 + blocks // 8 + 16)
    values = np.asarray(imagecodecs.zfp_decode(padded), np.float32)
    return {"values": _grid(values, shape)}


_SZ3_HEAD = struct.Struct("<IIQQ")
_SZ3_MAGIC = 0xF342F310
_SZ3_SLACK = 16 * 2**20
"""Bytes that a stream of SZ3 may have beside its values once its last stage is undone: tables of codes."""


def _check_sz3(data: bytes, shape: Sequence[int]) -> int:
    if len(data) < _SZ3_HEAD.size:
        raise ValueError("no stream of SZ3")
    magic, _, length, plain = _SZ3_HEAD.unpack_from(data)
    size = _in_memory(shape)
    if magic != _SZ3_MAGIC or length > len(data) or plain > 2 * size + _SZ3_SLACK:
        raise ValueError("no stream of SZ3 of that size")
    return size


def decode_sz3(data: bytes, shape: Sequence[int]) -> Arrays:
    """Values (nz, ny, nx) of SZ3."""
    import pysz

    values, _ = pysz.sz.decompress(np.frombuffer(data, np.uint8), np.float32, tuple(shape))
    return {"values": _grid(np.asarray(values, np.float32), shape)}


def _grid(values: NDArray[np.float32], shape: Sequence[int]) -> NDArray[np.float32]:
    if values.shape != tuple(shape):
        raise ValueError(f"a grid of {values.shape} in a file of {tuple(shape)}")
    if not np.isfinite(values).all():
        raise ValueError("its values are not finite")
    return values


def _in_memory(shape: Sequence[int]) -> int:
    """Bytes of a grid, of which this machine must have twice as many."""
    import psutil

    size, free = _FLOAT * math.prod(shape), psutil.virtual_memory().available
    if 2 * size > free:
        raise ValueError(f"a grid of {tuple(shape)} takes {2 * size} bytes of memory, and {free} are free")
    return size


# --------------------------------------------------------------------------- meshes

_DRACO_HEAD = struct.Struct("<5sBBB")
_DRACO_MESH = 1


def _check_draco(data: bytes) -> int:
    if len(data) < _DRACO_HEAD.size:
        raise ValueError("no stream of Draco")
    magic, _, _, kind = _DRACO_HEAD.unpack_from(data)
    if magic != b"DRACO" or kind != _DRACO_MESH:
        raise ValueError("a point cloud, no mesh" if magic == b"DRACO" and kind == 0 else "no mesh of Draco")
    return room(len(data))


def decode_draco(data: bytes) -> Arrays:
    """Points (N, 3) and faces (M, 3) of Draco."""
    import DracoPy

    mesh = DracoPy.decode(data)
    if not hasattr(mesh, "faces"):
        raise ValueError("no mesh, but a point cloud")
    points, faces = np.asarray(mesh.points, np.float64), np.asarray(mesh.faces, np.int64)
    return {"points": points.reshape(-1, 3), "faces": faces.reshape(-1, 3)}


# --------------------------------------------------------------------------- Gaussians

_SPZ_HEAD = struct.Struct("<4sIIBBBB")
_SPZ_POINT = {2: 9 + 1 + 3 + 3 + 3, 3: 9 + 1 + 3 + 3 + 4}
"""Version -> bytes of a Gaussian without coefficients."""
_SPZ_COEFFICIENTS = (0, 3, 8, 15)
GAUSSIAN = 4 * 59
"""Bytes of a Gaussian in memory."""


def _check_spz(data: bytes) -> int:
    head = gunzipped(data, _SPZ_HEAD.size)
    if len(head) < _SPZ_HEAD.size:
        raise ValueError("no SPZ")
    magic, version, count, degree, *_ = _SPZ_HEAD.unpack(head)
    if magic != b"NGSP" or version not in _SPZ_POINT or degree >= len(_SPZ_COEFFICIENTS):
        raise ValueError(f"no SPZ of version {' or '.join(map(str, _SPZ_POINT))}")
    size: int = _SPZ_HEAD.size + count * (_SPZ_POINT[version] + 3 * _SPZ_COEFFICIENTS[degree])
    check_count(count, len(data))
    if len(gunzipped(data, size + 1)) != size:
        raise ValueError(f"its header says {count} Gaussians, of {size} bytes, and it holds another number")
    return GAUSSIAN * int(count)


def check_count(count: int, size: int) -> None:
    """Check the number of Gaussians that a compressed file of so many bytes says it has.

    Raises:
        ValueError: none of its size has so many.
    """
    if not 0 <= GAUSSIAN * count <= room(size):
        raise ValueError(f"{count} Gaussians in {size} bytes")


def decode_spz(data: bytes) -> Arrays:
    """Tables of Gaussians, in the axes of SPZ; ``sh_rest`` (N, K, 3) with K of its degree."""
    import gsply

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "scene.spz")
        file.write_bytes(data)
        scene = gsply.read_spz(file)
    count = len(scene.means)
    rest = scene.shN if scene.shN is not None and scene.shN.size else np.zeros((count, 0, 3))
    tables = {
        "means": scene.means, "log_scales": scene.scales, "quats": scene.quats,
        "logits": np.asarray(scene.opacities).reshape(count),
        "sh_dc": np.asarray(scene.sh0).reshape(count, 1, 3), "sh_rest": rest,
    }  # fmt: skip
    return {name: np.array(table, np.float32) for name, table in tables.items()}


# --------------------------------------------------------------------------- pictures and bytes


def _webp_size(data: bytes) -> tuple[int, int]:
    """Width and height of a picture's header, of any of the three forms of WebP."""
    form, body = data[12:16], data[20:30]
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(body) < 10:
        raise ValueError("no WebP")
    if form == b"VP8L" and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if form == b"VP8X":
        return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
    if form == b"VP8 " and body[3:6] == b"\x9d\x01\x2a":
        return int.from_bytes(body[6:8], "little") & 0x3FFF, int.from_bytes(body[8:10], "little") & 0x3FFF
    raise ValueError("no WebP")


def _check_webp(data: bytes, lengths: Sequence[int], most: Sequence[int]) -> int:
    start = pixels = 0
    for length, limit in zip(lengths, most, strict=True):
        width, height = _webp_size(data[start : start + length])
        if width * height > limit:
            raise ValueError(f"a picture of {width} x {height} pixels, and {limit} are the most")
        start, pixels = start + length, pixels + width * height
    return 4 * pixels


def decode_webp(data: bytes, lengths: Sequence[int], most: Sequence[int]) -> Arrays:
    """Pictures (height, width, 3 or 4), one byte a channel, of several files of WebP in a row.

    Args:
        data: the files.
        lengths: bytes of each.
        most: pixels that each may have.
    """
    import imagecodecs

    start, pictures = 0, {}
    for number, length in enumerate(lengths):
        picture = np.asarray(imagecodecs.webp_decode(data[start : start + length]))
        if picture.ndim != 3 or picture.shape[2] not in (3, 4) or picture.dtype != np.uint8:
            raise ValueError(f"a picture of shape {picture.shape}")
        pictures[str(number)] = picture
        start += length
    return pictures


def _check_zstd(data: bytes) -> int:
    return room(len(data))


def decode_zstd(data: bytes) -> Arrays:
    """Bytes of a frame of Zstandard, no more than its size allows."""
    import pyarrow

    most = room(len(data))
    with pyarrow.CompressedInputStream(pyarrow.BufferReader(data), "zstd") as stream:
        plain = stream.read(most + 1)
    if len(plain) > most:
        raise ValueError(f"{len(data)} bytes hold more than {most}")
    return {"bytes": np.frombuffer(plain, np.uint8)}


_DECODERS: dict[str, Callable[..., Arrays]] = {
    "zfp": decode_zfp, "sz3": decode_sz3, "draco": decode_draco, "spz": decode_spz, "webp": decode_webp,
    "zstd": decode_zstd,
}  # fmt: skip
_CHECKS: dict[str, Callable[..., int]] = {
    "zfp": _check_zfp, "sz3": _check_sz3, "draco": _check_draco, "spz": _check_spz, "webp": _check_webp,
    "zstd": _check_zstd,
}  # fmt: skip
"""Codec -> what compares a header with the file around it; returns the bytes that the arrays will take."""
