"""The standard PLY of 3D Gaussian splats: 62 float32 per Gaussian, as splat viewers read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError

PARTS: dict[str, tuple[str, ...]] = {
    "positions": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),  # always zero: the format has them, the method does not
    "sh_dc": tuple(f"f_dc_{i}" for i in range(3)),
    "sh_rest": tuple(f"f_rest_{i}" for i in range(45)),
    "opacity": ("opacity",),
    "scale": tuple(f"scale_{i}" for i in range(3)),
    "rotation": tuple(f"rot_{i}" for i in range(4)),
}
"""Part of the ledger -> its properties, in the order of the file."""

PROPERTIES = tuple(name for names in PARTS.values() for name in names)
BYTES_PER_GAUSSIAN = 4 * len(PROPERTIES)

_MAX_HEADER = 1 << 16
_REMEDY = "Give a binary little-endian PLY of Gaussian splats with SH degree 3 (62 float32 each)"


def write_ply(path: Path, rows: NDArray[np.float32]) -> dict[str, int]:
    """Write (N, 62) ``rows``, columns as in ``PROPERTIES``.

    Returns:
        Bytes by part; "header" and the parts sum to the size of the file.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in PROPERTIES]
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    with path.open("wb") as file:
        file.write(header)
        file.write(np.ascontiguousarray(rows, dtype="<f4").tobytes())
    return {"header": len(header)} | {part: 4 * len(names) * len(rows) for part, names in PARTS.items()}


def read_ply(path: Path) -> NDArray[np.float32]:
    """Read the (N, 62) values of a splat PLY, columns as in ``PROPERTIES`` whatever their order there.

    Raises:
        DataError: no such file, or not a PLY of this kind.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_MAX_HEADER)
            count, names, start = _parse_header(path, head)
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
    columns = [names.index(name) for name in PROPERTIES]
    rows = values.reshape(count, len(names))[:, columns].astype(np.float32, copy=False)
    if not np.isfinite(rows).all():
        raise DataError(path, "holds NaN or infinite values", "The file is damaged, or its training diverged")
    return rows


def _parse_header(path: Path, head: bytes) -> tuple[int, list[str], int]:
    """Number of vertices, property names in file order, offset of the data."""
    marker = b"end_header\n"
    end = head.find(marker)
    if not head.startswith(b"ply") or end < 0:
        raise DataError(path, "not a PLY file", _REMEDY)
    lines = [line.split() for line in head[:end].decode("ascii", "replace").splitlines()]
    count: int | None = None
    names: list[str] = []
    for words in lines[1:]:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", "binary_little_endian", "1.0"]:
                pass
            case ["element", "vertex", number] if number.isdecimal() and count is None:
                count = int(number)
            case ["property", "float" | "float32", name] if count is not None and name not in names:
                names.append(name)
            case _:
                raise DataError(path, f"unexpected header line {' '.join(words)!r}", _REMEDY)
    if count is None:
        raise DataError(path, "no element vertex in the header", _REMEDY)
    missing = [name for name in PROPERTIES if name not in names]
    if missing:
        raise DataError(path, f"property {missing[0]!r} is missing ({len(missing)} in all)", _REMEDY)
    return count, names, end + len(marker)
