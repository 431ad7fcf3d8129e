"""Bounded reading of what others wrote: no header and no ratio of compression decides what it takes."""

from __future__ import annotations

import json
import lzma
import math
import re
import zipfile
import zlib
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

DEPTH = 64
"""Arrays and objects of JSON within each other; what this program writes has fewer than 20."""
_RATIO = 100
_LEAST = 64 * 2**20
_XZ_MEMORY = 128 * 2**20
"""Bytes; the strongest preset of xz takes 65 MiB."""
_XZ_PIECE = 2**20
_VALUES_PER_BYTE = 4
_LEAST_VALUES = 1_000_000
_TEXT = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_EXPONENTS = re.compile(r"e\+?\d{3,}[\s,\]}]"), re.compile(r"E\+?\d{3,}[\s,\]}]")
"""Two patterns: each begins with one sign, for which text is searched fast."""
_BRACKETS = re.compile(r"[\[\]{}]")


def room(size: int) -> int:
    """Bytes that so many compressed bytes may become: 64 MiB, or 100 times as many.

    Deflate reaches 1,032 on zeros and zstd more; models, records and volumes reach 40.
    """
    return max(_LEAST, _RATIO * size)


def values_room(size: int) -> int:
    """Values that the JSON in so many compressed bytes may have; each takes 20 to 100 bytes of memory."""
    return max(_LEAST_VALUES, _VALUES_PER_BYTE * size)


def number_of_values(text: str) -> int:
    """At least as many values as a text of JSON has."""
    return text.count(",") + text.count("[") + text.count("{") + 1


def json_of(data: bytes | str, most: int = _LEAST_VALUES, *, finite: bool = True) -> Any:
    """The value of a text of JSON.

    Args:
        data: the text; bytes are UTF-8.
        most: number of values that it may have.
        finite: whether every number must be finite, and a whole one of 64 bits.

    Raises:
        ValueError: it is no JSON, has more values, arrays and objects within each other beyond
            :data:`DEPTH`, or a number that is not finite.
    """
    text = data if isinstance(data, str) else data.decode("utf-8")
    if (values := number_of_values(text)) > most:
        raise ValueError(f"{values} values of JSON, and {most} are the most")
    if text.count("[") + text.count("{") > DEPTH and (depth := _depth(text)) > DEPTH:
        raise ValueError(f"{depth} arrays and objects within each other, and {DEPTH} are the most")
    if not finite:
        return json.loads(text)
    return json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_whole)


def check_finite(text: str) -> None:
    """Check that JSON whose number of values is bounded has no number that is not finite.

    Raises:
        ValueError: as :func:`json_of`.
    """
    if "NaN" in text or "Infinity" in text or any(sign.search(text) for sign in _EXPONENTS):
        json_of(text, len(text))


def _depth(text: str) -> int:
    depth = deepest = 0
    for bracket in _BRACKETS.findall(_TEXT.sub('""', text)):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    return deepest


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"the number {text} is not finite")
    return number


def _whole(text: str) -> int:
    if len(text) > 20 or not -(2**63) <= (number := int(text)) < 2**63:
        raise ValueError(f"the number {text[:24]} has more than 64 bits")
    return number


def inflated(data: bytes, size: int) -> bytes:
    """The bytes of a deflated stream, whose number is known.

    Args:
        data: the stream.
        size: number of bytes.

    Raises:
        ValueError: it is damaged, or holds another number of bytes.
    """
    decoder = zlib.decompressobj()
    try:
        plain = decoder.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"a deflated stream is damaged ({error})") from error
    if len(plain) != size or not decoder.eof:
        held = "more" if len(plain) > size else str(len(plain))
        raise ValueError(f"a deflated stream holds {held} bytes, not {size}")
    return plain


def decompress_xz(source: IO[bytes], out: IO[bytes], most: int) -> None:
    """Write the bytes that a file of xz holds.

    Args:
        source: the file.
        out: where they go.
        most: number of bytes that it may hold.

    Raises:
        ValueError: it is damaged, holds more bytes or more than one stream, or needs more than 128 MiB of
            memory.
    """
    decoder, left = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY), most
    try:
        while not decoder.eof:
            data = source.read(_XZ_PIECE) if decoder.needs_input else b""
            if decoder.needs_input and not data:
                raise ValueError("a stream of xz was cut")
            plain = decoder.decompress(data, _XZ_PIECE)
            if (left := left - len(plain)) < 0:
                raise ValueError(f"a stream of xz holds more than {most} bytes")
            out.write(plain)
    except (lzma.LZMAError, MemoryError) as error:
        raise ValueError(f"a stream of xz is damaged ({error})") from error
    if decoder.unused_data or source.read(1):
        raise ValueError("a stream of xz is followed by other bytes")


def opened(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """A member of an archive, to be read in pieces: one that is stored or deflated.

    Python unpacks pieces of LZMA and bzip2 without a bound; a kilobyte of the latter holds a gigabyte.

    Raises:
        KeyError: there is none.
        ValueError: it is compressed by another method.
        zipfile.BadZipFile: the archive is damaged.
    """
    info = archive.getinfo(name)
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is neither stored nor deflated")
    return archive.open(info)


def array_of(archive: zipfile.ZipFile, name: str, kind: type, axes: int, most: int) -> NDArray[Any]:
    """An array of an archive of NumPy; its header is checked before its values are read.

    Args:
        archive: the archive.
        name: of the array.
        kind: its type.
        axes: their number.
        most: number of values that it may have.

    Raises:
        KeyError: it has no such array.
        ValueError: the array is damaged, larger or of another type.
        zipfile.BadZipFile, zlib.error, EOFError: the archive is damaged.
    """
    info = archive.getinfo(f"{name}.npy")
    with opened(archive, f"{name}.npy") as file:
        shape, fortran, dtype = header_of(file)
        count = math.prod(shape)
        if dtype != kind or len(shape) != axes or min(shape, default=0) < 0:
            raise ValueError(f"{name} is {dtype} of {len(shape)} axes")
        if count > most or info.file_size != file.tell() + count * dtype.itemsize:
            raise ValueError(f"{name} has {count} values in {info.file_size} bytes, at most {most} are read")
        values: NDArray[Any] = np.empty(count, dtype)
        if file.readinto(values.view(np.uint8).data) != values.nbytes:  # type: ignore[attr-defined]
            raise EOFError(f"{name} was cut")
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)


def header_of(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order (whether Fortran's) and type of an array in NumPy's format.

    Raises:
        ValueError: the header is damaged; NumPy's parser fails in many ways.
        zipfile.BadZipFile, zlib.error, EOFError: the archive that it is read from is damaged.
    """
    try:
        version = np.lib.format.read_magic(file)
        formats = np.lib.format
        read = formats.read_array_header_1_0 if version == (1, 0) else formats.read_array_header_2_0
        return read(file)
    except (zipfile.BadZipFile, zlib.error, EOFError):
        raise
    except (Exception, MemoryError) as error:
        raise ValueError(f"the header of an array is damaged ({type(error).__name__})") from error


def gunzipped(data: bytes, most: int) -> bytes:
    """The first bytes of a stream of gzip, at most so many.

    Raises:
        ValueError: it is damaged.
    """
    try:
        return zlib.decompressobj(31).decompress(data, max(most, 1))
    except zlib.error as error:
        raise ValueError(f"a stream of gzip is damaged ({error})") from error
