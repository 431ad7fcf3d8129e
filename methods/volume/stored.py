"""A volume as a fit keeps it, and as a file.

A file holds a magic number, the length of the header, the header (JSON), the stream of the compressor, the
mask (bits, deflated) if there is one, and the CRC-32 of all before.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.bounded import inflated, json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.shared.decoders import own_streams
from econgs_bench.methods.volume.codecs import Codec, Grid

SUFFIX = ".volume"
_MAGIC = b"\x89VOLUME1"
_HEAD = struct.Struct("<8sI")
_CHECK = struct.Struct("<I")
_ANEW = "Save the model again"
_WHOLE = ("uint8", "int8", "uint16", "int16")
_SLACK = 0.45
"""Error bound, in steps of whole numbers, at which rounding finds each of them again."""


@dataclass(frozen=True, eq=False)
class Samples:
    """What scenes need of a volume.

    Attributes:
        variable: name.
        values: (nz, ny, nx) normalised.
        mask: as of :class:`.datasets.volume.Volume`.
        spacing: as there.
        value_range: as there.
        dtype: type of the data values; "float32" unless they are whole numbers of at most 16 bits.
    """

    variable: str
    values: Grid
    mask: NDArray[np.bool_] | None
    spacing: tuple[float, float, float]
    value_range: tuple[float, float]
    dtype: str

    @classmethod
    def of(cls, volume: Volume) -> Samples:
        """The samples of a volume."""
        low, high = (float(end) for end in volume.value_range)
        whole = volume.values.dtype.kind in "iu" and volume.values.dtype.itemsize <= 2
        whole &= low.is_integer() and high.is_integer()
        dtype = volume.values.dtype.name if whole else "float32"
        x, y, z = (float(length) for length in volume.spacing)
        return cls(volume.name, volume.normalised(), volume.mask, (x, y, z), (low, high), dtype)

    def arrays(self) -> dict[str, Tensor]:
        """The arrays, for a checkpoint."""
        arrays = {"values": torch.from_numpy(self.values)}
        return arrays if self.mask is None else arrays | {"mask": torch.from_numpy(self.mask)}

    def scalars(self) -> dict[str, Any]:
        """The rest, for a checkpoint."""
        return {name: getattr(self, name) for name in ("variable", "spacing", "value_range", "dtype")}

    @classmethod
    def restored(cls, arrays: Mapping[str, Tensor], scalars: Mapping[str, Any]) -> Samples:
        """The samples in a checkpoint."""
        mask = arrays["mask"].cpu().numpy() if "mask" in arrays else None
        spacing, value_range = tuple(scalars["spacing"]), tuple(scalars["value_range"])
        values = arrays["values"].cpu().numpy()
        return cls(scalars["variable"], values, mask, spacing, value_range, scalars["dtype"])

    def stored(self, codec: Codec, bound: float) -> StoredVolume:
        """The volume, compressed.

        Whole numbers whose error would stay under half a step are stored without loss, at the widest bound
        that rounding undoes.

        Args:
            codec: the compressor.
            bound: greatest absolute error, as a share of the value range.
        """
        low, high = self.value_range
        exact = self.dtype != "float32" and bound * (high - low) < 0.5 and codec.bounded
        within = _SLACK / (high - low) if exact else bound
        stream = codec.compress(np.ascontiguousarray(self.values), within)
        mask = b"" if self.mask is None else zlib.compress(np.packbits(self.mask).tobytes(), 9)
        header = {
            "codec": codec.name,
            "variable": self.variable,
            "shape": list(self.values.shape),
            "spacing": list(self.spacing),
            "range": [low, high],
            "dtype": self.dtype,
            "bound": bound,
            "exact": exact,
            "stream": len(stream),
            "mask": len(mask),
        }
        text = json.dumps(header, separators=(",", ":")).encode()
        data = b"".join([_HEAD.pack(_MAGIC, len(text)), text, stream, mask])
        with own_streams():
            return read(data + _CHECK.pack(zlib.crc32(data)), codec, self.variable)


@dataclass(frozen=True, eq=False)
class StoredVolume:
    """A compressed volume.

    Attributes:
        volume: decompressed.
        data: bytes of the file.
        bound: greatest absolute error that was asked for, as a share of the value range.
        parts: part -> bytes, which sum to the file's.
    """

    volume: Volume
    data: bytes
    bound: float
    parts: Mapping[str, int]

    @property
    def file(self) -> str:
        """Name of its file, with the checksum: two volumes of one variable have two."""
        (check,) = _CHECK.unpack(self.data[-_CHECK.size :])
        return f"{quote(self.volume.name, safe=' ')}-{check:08x}{SUFFIX}"


def read(data: bytes, codec: Codec, what: str) -> StoredVolume:
    """The volume of a file's bytes.

    Args:
        data: all bytes.
        codec: the compressor that it must be of.
        what: file or object, for messages.

    Raises:
        DataError: the bytes are damaged, foreign or of another compressor.
        Refused: the compressor is not installed.
    """
    try:
        header, stream, packed = _sections(data)
        if header["codec"] != codec.name:
            raise ValueError(f"compressed by {header['codec']}, not by {codec.name}")
        nz, ny, nx = (int(n) for n in header["shape"])
        low, high = (float(end) for end in header["range"])
        x, y, z = (float(length) for length in header["spacing"])
        name = header["variable"]
        bound, exact = float(header["bound"]), bool(header["exact"])
        if not isinstance(name, str):
            raise ValueError("its variable has no name")
        if min(nz, ny, nx) < 2 or not (min(x, y, z) > 0.0 and math.isfinite(x + y + z) and low < high):
            raise ValueError("no grid")
        dtype = header["dtype"]
        types = _WHOLE if exact else ("float32", *_WHOLE)
        if not math.isfinite(high - low) or dtype not in types or (exact and not _holds(dtype, low, high)):
            raise ValueError(f"values of type {dtype!r} in [{low:g}, {high:g}]")
        values = codec.restore(stream, (nz, ny, nx))
        mask = None
        if packed:
            bits = np.frombuffer(inflated(packed, -(-values.size // 8)), np.uint8)
            mask = np.unpackbits(bits, count=values.size).astype(bool).reshape(values.shape)
        if exact:
            with np.errstate(over="ignore"):
                values *= np.float32(high - low)
                values += np.float32(low)
            np.rint(values, out=values)
            if not _holds(dtype, float(values.min()), float(values.max())):
                raise ValueError(f"values beyond those of {dtype}")
            volume = Volume(name, values.astype(dtype), (x, y, z), (low, high), what, mask)
        else:
            volume = Volume(name, values, (x, y, z), (0.0, 1.0), what, mask)
    except (ValueError, KeyError, TypeError, OverflowError, struct.error) as error:
        raise DataError(what, f"not a volume compressed by {codec.name} ({error})", _ANEW) from error
    parts = {"volume": len(stream), "mask": len(packed)} if packed else {"volume": len(stream)}
    return StoredVolume(volume, data, bound, {**parts, "header": len(data) - sum(parts.values())})


def _holds(dtype: str, low: float, high: float) -> bool:
    return np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max


def _sections(data: bytes) -> tuple[dict[str, Any], bytes, bytes]:
    """Header, stream and mask of undamaged bytes."""
    magic, length = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError("its first bytes differ")
    body = data[: -_CHECK.size]
    if _CHECK.pack(zlib.crc32(body)) != data[-_CHECK.size :]:
        raise ValueError("cut or damaged: its checksum differs")
    start = _HEAD.size + length
    header = json_of(body[_HEAD.size : start])
    middle = start + int(header["stream"])
    if middle + int(header["mask"]) != len(body):
        raise ValueError("its sections have other lengths than its header says")
    return header, body[start:middle], body[middle:]
