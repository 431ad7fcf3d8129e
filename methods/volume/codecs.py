"""Compressors of float32 grids with a bound on the absolute error, by their official libraries."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.decoders import decoded

Grid = NDArray[np.float32]
_MISSING = "{} needs the package {}: pip install 'econgs-bench[rivals]'"


class Codec(ABC):
    """A lossy compressor.

    Attributes:
        name: of the method and in files.
        bounded: whether errors have a bound.
    """

    name: str
    bounded = True

    @abstractmethod
    def compress(self, values: Grid, bound: float) -> bytes:
        """The stream of a grid (nz, ny, nx).

        Args:
            values: contiguous, in [0, 1].
            bound: greatest absolute error.

        Raises:
            Refused: the library is not installed.
        """

    def restore(self, stream: bytes, shape: tuple[int, ...]) -> Grid:
        """The values of a stream (:func:`.methods.shared.decoders.decoded`).

        Args:
            stream: that :meth:`compress` returned.
            shape: of the grid.

        Raises:
            ValueError: it is damaged, or of another grid.
            Refused: the library is not installed.
        """
        return np.asarray(decoded(self.name, stream, shape=list(shape))["values"])


class Sz3(Codec):
    """SZ3 at its default algorithm: interpolation or Lorenzo prediction, Huffman coding, zstd."""

    name = "sz3"

    def compress(self, values: Grid, bound: float) -> bytes:
        pysz = _pysz()
        config = pysz.szConfig()
        config.errorBoundMode = pysz.szErrorBoundMode.ABS
        config.absErrorBound = bound
        stream, _ = pysz.sz.compress(values, config)
        return bytes(stream)


class Zfp(Codec):
    """zfp in its mode of fixed accuracy, or in that of fixed rate at the same size.

    Args:
        fixed_rate: every block of 4 x 4 x 4 values has as many bits, at least nine, so that each can be read
            without those before it; errors have no bound then.
    """

    name = "zfp"

    def __init__(self, fixed_rate: bool = False) -> None:
        self.bounded = not fixed_rate

    def compress(self, values: Grid, bound: float) -> bytes:
        zfp = _imagecodecs()
        stream = bytes(zfp.zfp_encode(values, mode="a", level=bound))
        if not self.bounded:
            padded = math.prod(-(-n // 4) * 4 for n in values.shape)
            stream = bytes(zfp.zfp_encode(values, mode="r", level=8 * len(stream) / padded))
        return stream


def _pysz() -> Any:
    try:
        import pysz
    except ImportError as error:
        raise Refused(_MISSING.format("sz3", "pysz")) from error
    return pysz


def _imagecodecs() -> Any:
    """It holds the official zfp. With zfpy installed, numcodecs 0.16 and so zarr could not be imported."""
    import imagecodecs

    if not imagecodecs.ZFP.available:
        raise Refused("zfp needs an imagecodecs that was built with zfp: pip install imagecodecs")
    return imagecodecs
