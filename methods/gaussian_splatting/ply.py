"""PLY tables of float32; by default the 62 columns per Gaussian that splat viewers read."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError

Parts = Mapping[str, tuple[str, ...]]

PARTS: Parts = {
    "positions": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),  # always zero: the format has them, the method does not
    "sh_dc": tuple(f"f_dc_{i}" for i in range(3)),
    "sh_rest": tuple(f"f_rest_{i}" for i in range(45)),
    "opacity": ("opacity",),
    "scale": tuple(f"scale_{i}" for i in range(3)),
    "rotation": tuple(f"rot_{i}" for i in range(4)),
}
"""Part of the ledger -> its properties, in the order of the file."""

LARGEST_LOG = float(np.log(np.finfo(np.float32).max))
"""Of a scale in float32."""
_SUM = "crc32"
"""Name of the comment with the checksum of the data, which other writers lack."""
ANTIALIASED = "SplatRenderMode: mip"
"""Comment of Brush and PlayCanvas: viewers shall shrink opacities to compensate for their filter."""
_MODES = {
    ("splatrendermode:", "mip"): True, ("splatrendermode:", "default"): False,
    ("splatrendermode:", "2dgs"): False, ("antialiased", "1"): True, ("antialiased", "0"): False,
    ("postshot.anti_aliasing=1",): True, ("postshot.anti_aliasing=0",): False,
}  # fmt: skip
"""Words of comments, in small letters, that say whether they shall: of Brush, and of Postshot."""
_MAX_HEADER = 1 << 16


def properties(parts: Parts) -> tuple[str, ...]:
    """The columns of a table, in order."""
    return tuple(name for names in parts.values() for name in names)


def write_ply(
    path: Path, rows: NDArray[np.float32], parts: Parts = PARTS, comments: Sequence[str] = ()
) -> dict[str, int]:
    """Write (N, columns) ``rows``, columns as in ``properties(parts)``, and comments of the header.

    Returns:
        Bytes by part; "header" and the parts sum to the size of the file.
    """
    data = np.ascontiguousarray(rows, dtype="<f4").tobytes()
    lines = ["ply", "format binary_little_endian 1.0", f"comment {_SUM} {zlib.crc32(data):08x}"]
    lines += [*(f"comment {comment}" for comment in comments), f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in properties(parts)]
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    with path.open("wb") as file:
        file.write(header)
        file.write(data)
    return {"header": len(header)} | {part: 4 * len(names) * len(rows) for part, names in parts.items()}


def read_ply(path: Path, parts: Parts = PARTS) -> NDArray[np.float32]:
    """Read the (N, columns) values of a PLY, columns as in ``properties(parts)`` whatever their order there.

    Raises:
        DataError: no such file, or not a PLY of this kind.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_MAX_HEADER)
            count, names, start, checksum, _ = _parse_header(path, head, properties(parts))
            payload = path.stat().st_size - start
            expected = 4 * len(names) * count
            if payload != expected:
                raise DataError(
                    path, f"{payload} bytes after the header instead of {expected}", "The file is damaged"
                )
            file.seek(start)
            values = np.fromfile(file, dtype="<f4", count=len(names) * count)
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "Check the path") from error
    if checksum not in (None, f"{zlib.crc32(values.tobytes()):08x}"):
        raise DataError(path, "its checksum differs", "The file is damaged: save the model again")
    columns = [names.index(name) for name in properties(parts)]
    rows = values.reshape(count, len(names))[:, columns].astype(np.float32, copy=False)
    wrong = ""
    if not np.isfinite(rows).all():
        wrong = "NaN or infinite values"
    elif (rows[:, _places(parts, "scale_")] > LARGEST_LOG).any():
        wrong = "a scale whose exponential is infinite"
    elif "rotation" in parts and no_turn(rows[:, _places(parts, "rot_")]):
        wrong = "a rotation that is zero, or too long"
    if wrong:
        raise DataError(path, f"holds {wrong}", "The file is damaged, or its training diverged")
    return rows


class AnyPly(NamedTuple):
    """A PLY of any trainer.

    Attributes:
        rows: (N, 62) values, columns as in ``properties(PARTS)``.
        degree: of spherical harmonics.
        antialiased: whether it says that viewers shall compensate for their filter.
    """

    rows: NDArray[np.float32]
    degree: int
    antialiased: bool


def read_any(path: Path) -> AnyPly:
    """Read a PLY of any trainer.

    Normals may be missing, and coefficients beyond its degree, which become zeros.

    Raises:
        DataError: as :func:`read_ply`.
    """
    least = {part: columns for part, columns in PARTS.items() if part not in ("normals", "sh_rest")}
    try:
        with path.open("rb") as file:
            header = _parse_header(path, file.read(_MAX_HEADER), properties(least))
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "Check the path") from error
    count = sum(name.startswith("f_rest_") for name in header.names)
    if count not in (degrees := {0: 0, 9: 1, 24: 2, 45: 3}):
        raise DataError(path, f"has {count} coefficients f_rest", f"Write {', '.join(map(str, degrees))}")
    rows = read_ply(path, least | ({"sh_rest": PARTS["sh_rest"][:count]} if count else {}))
    whole = np.zeros((len(rows), len(properties(PARTS))), np.float32)
    if count:  # channel after channel
        rest = rows[:, 14:].reshape(len(rows), 3, count // 3)
        padded = np.pad(rest, ((0, 0), (0, 0), (0, 15 - count // 3)))
        whole[:, _places(PARTS, "f_rest_")] = padded.reshape(len(rows), 45)
    whole[:, :3], whole[:, 6:9], whole[:, 54:] = rows[:, :3], rows[:, 3:6], rows[:, 6:14]
    return AnyPly(whole, degrees[count], header.antialiased)


def no_turn(quats: NDArray[np.float32]) -> bool:
    """Whether one of (N, 4) quaternions cannot be brought to length 1 (torch.nn.functional.normalize)."""
    largest = np.abs(quats).max(axis=1)
    return bool(((largest < 1e-12) | (largest > 1e18)).any())


def _places(parts: Parts, prefix: str) -> list[int]:
    return [place for place, name in enumerate(properties(parts)) if name.startswith(prefix)]


class _Header(NamedTuple):
    """Number of vertices, property names in file order, offset and checksum of the data, and the mark."""

    vertices: int
    names: list[str]
    start: int
    checksum: str | None
    antialiased: bool


def _parse_header(path: Path, head: bytes, columns: tuple[str, ...]) -> _Header:
    remedy = (
        f"Give a binary little-endian PLY with these {len(columns)} float32: {columns[0]} ... {columns[-1]}"
    )
    marker = b"end_header\n"
    end = head.find(marker)
    if not head.startswith(b"ply") or end < 0:
        raise DataError(path, "not a PLY file", remedy)
    lines = [line.split() for line in head[:end].decode("ascii", "replace").splitlines()]
    count: int | None = None
    checksum: str | None = None
    antialiased = False
    names: list[str] = []
    for words in lines[1:]:
        match words:
            case ["comment", name, digits] if name == _SUM:
                checksum = digits
            case ["comment", *mode]:  # the last one counts
                antialiased = _MODES.get(tuple(word.lower() for word in mode), antialiased)
            case [] | ["obj_info", *_]:
                pass
            case ["format", "binary_little_endian", "1.0"]:
                pass
            case ["element", "vertex", number] if number.isdecimal() and len(number) < 16 and count is None:
                count = int(number)
            case ["property", "float" | "float32", name] if count is not None and name not in names:
                names.append(name)
            case _:
                raise DataError(path, f"unexpected header line {' '.join(words)!r}", remedy)
    if count is None:
        raise DataError(path, "no element vertex in the header", remedy)
    missing = [name for name in columns if name not in names]
    if missing:
        raise DataError(path, f"property {missing[0]!r} is missing ({len(missing)} in all)", remedy)
    return _Header(count, names, end + len(marker), checksum, antialiased)
