"""Our own format: attributes as whole numbers of steps, entropy-coded by the integer coder of the bitstream.

Positions are an octree, in whose Morton order all else follows. Of the 24 ways to name an ellipsoid's axes,
that of the least turn is stored: its quaternion has no sign and no largest number to tell. Colors have
coarser steps where a Gaussian weighs little in pictures. A column's numbers, or their differences from one
Gaussian to the next, have normal distributions in classes of Gaussians: equal parts of these ranked by a key,
which is made of columns that are known by then. The writer takes what costs least. All that the coder depends
on is whole numbers.
"""

from __future__ import annotations

import itertools
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.econgs.codec.coder import Decoder, Encoder, read_residuals, write_residuals
from econgs_bench.econgs.codec.positions import (
    PositionGrid,
    decode_positions,
    encode_positions,
    morton_order,
)
from econgs_bench.econgs.codec.tables import (
    FREQUENCY_BITS,
    MEAN_PARTS,
    SPREAD_OCTAVES,
    SPREAD_PER_OCTAVE,
    SPREADS,
    coding_table,
    low_bits,
    table_index,
)
from econgs_bench.methods.formats.gaussians import (
    COEFFICIENTS,
    SHAPES,
    Contents,
    Tables,
    checked,
    degree_of,
    tables,
)
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians

SUFFIX = ".ints"
MAGIC = b"\x89GAUSS\n1"
_HEAD = struct.Struct("<8sIIB3x6d3I5f")  # magic, checksum of the rest, Gaussians, degree, grid, steps
_CHECKED = 12  # bytes before what the checksum covers
_LENGTH = struct.Struct("<I")
_COLUMN = struct.Struct("<BB")  # whether differences, key
_CLASS = struct.Struct("<iB")  # mean in sixteenths of a step, spread
CLASSES = 8
_LEAST_CLASS = 256  # Gaussians
_WIDEST = 1 << 22  # symbols are less

STEPS = {"log_scales": 0.07, "logits": 0.1, "quats": 0.018, "sh_dc": 0.05, "sh_rest": 0.1}
"""At factor 1; so chosen on fitted models that all attributes lose about as much per byte."""
CELL = 0.08
"""Side of a cell of positions at factor 1: share of the median of the Gaussians' geometric mean scales."""

COARSER = (-1, 1)
"""Least and largest power of 2 on a Gaussian's steps of color."""
_UNIT = 4096  # fixed point of logarithms
_OCTAVE = 2839  # ln 2 of them

Whole = NDArray[np.int64]


@dataclass(frozen=True)
class _Quantised:
    """A scene in whole numbers, in Morton order.

    Attributes:
        grid, codes: of positions.
        steps: of the attributes.
        columns: attribute -> (N, width) whole numbers.
    """

    grid: PositionGrid
    codes: Whole
    steps: Mapping[str, float]
    columns: Mapping[str, Whole]


def write(
    file: Path, scene: SceneGaussians, factor: float = 1.0, *, antialiased: bool = False
) -> Mapping[str, int]:
    """Write a scene; bytes by part.

    Args:
        file: where to.
        scene: its Gaussians.
        factor: on all steps.
        antialiased: the format has no mark for it.
    """
    degree = degree_of(scene)
    whole = _quantised(tables(scene), degree, factor)
    grid = whole.grid
    sections = {"positions": encode_positions(whole.codes, grid) if len(scene) else b""}
    known: dict[str, Whole] = {}
    for name, columns in whole.columns.items():
        sections[name] = _encoded(columns, _keys(known, len(scene))) if len(scene) else b""
        known[name] = columns
    steps = [whole.steps[name] for name in STEPS]
    rest = _HEAD.pack(b"", 0, len(scene), degree, *grid.origin, *grid.cell, *grid.extent, *steps)[_CHECKED:]
    rest += b"".join(_LENGTH.pack(len(part)) + part for part in sections.values())
    total = file.write_bytes(MAGIC + struct.pack("<I", zlib.crc32(rest)) + rest)
    parts = {name: len(part) for name, part in sections.items()}
    return parts | {"header": total - sum(parts.values())}


def read(file: Path) -> Contents:
    """Read a scene.

    Raises:
        DataError: the file is missing, damaged or of another kind.
    """
    return checked(file, "whole numbers of Gaussians", lambda: Contents(_parsed(file.read_bytes())))


def _parsed(data: bytes) -> Tables:
    if len(data) < _HEAD.size or not data.startswith(MAGIC):
        raise ValueError("its first bytes differ")
    _, check, count, degree, *numbers = _HEAD.unpack_from(data)
    if zlib.crc32(data[_CHECKED:]) != check:
        raise ValueError("its checksum differs")
    origin, cell, extent = (tuple(numbers[at : at + 3]) for at in (0, 3, 6))
    grid = PositionGrid(origin, cell, extent)
    at = _HEAD.size

    def section() -> bytes:
        nonlocal at
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size + length
        return data[at - length : at]

    positions = section()
    codes = decode_positions(positions, count, grid) if count else np.zeros((0, 3), np.int64)
    columns: dict[str, Whole] = {}
    for name, width in _widths(degree).items():
        part = section()
        columns[name] = _decoded(part, width, _keys(columns, count), count)
    if at != len(data):
        raise ValueError("its parts do not fill it")
    return _restored(_Quantised(grid, codes, dict(zip(STEPS, numbers[9:], strict=True)), columns), degree)


# --------------------------------------------------------------------------- whole numbers


def _widths(degree: int) -> dict[str, int]:
    """Groups of columns in the order of the file -> columns."""
    widths = {"log_scales": 3, "logits": 1, "quats": 3, "sh_dc": 3}
    return widths | {f"sh{one}": 3 * (2 * one + 1) for one in range(1, degree + 1)}


def _quantised(values: Tables, degree: int, factor: float) -> _Quantised:
    count = len(values["means"])
    steps = {name: float(np.float32(factor * step)) for name, step in STEPS.items()}
    scales, vectors = least_turn(values["log_scales"], values["quats"])
    rows = {**values, "log_scales": scales, "quats": vectors}
    columns = {
        name: np.rint(_flat(rows[name]) / steps[name]).astype(np.int64)
        for name in ("log_scales", "logits", "quats")
    }
    powers = _powers(columns, steps)
    columns["sh_dc"] = np.rint(_flat(values["sh_dc"]) / (steps["sh_dc"] * powers)).astype(np.int64)
    for one in range(1, degree + 1):
        part = _flat(values["sh_rest"][:, COEFFICIENTS[one - 1] : COEFFICIENTS[one]])
        columns[f"sh{one}"] = np.rint(part / (steps["sh_rest"] * powers)).astype(np.int64)
    columns = {name: np.clip(one, 1 - _WIDEST, _WIDEST - 1) for name, one in columns.items()}
    if not count:
        return _Quantised(PositionGrid.box((0, 0, 0), (1, 1, 1)), np.zeros((0, 3), np.int64), steps, columns)
    cell = factor * CELL * float(np.exp(np.median(scales.mean(1, dtype=np.float64))))
    grid = PositionGrid.lattice(max(cell, 1e-9), values["means"])
    codes = grid.codes(values["means"])
    order = morton_order(codes)
    return _Quantised(grid, codes[order], steps, {name: one[order] for name, one in columns.items()})


def _flat(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _restored(whole: _Quantised, degree: int) -> Tables:
    count = len(whole.codes)
    real = {
        name: (columns * whole.steps["sh_rest" if name[:2] == "sh" and name != "sh_dc" else name])
        for name, columns in whole.columns.items()
    }
    powers = _powers(whole.columns, whole.steps)
    real |= {name: columns * powers for name, columns in real.items() if name[:2] == "sh"}
    vectors = real["quats"]
    w = np.sqrt(np.maximum(0.0, 1.0 - np.square(vectors).sum(1, keepdims=True)))
    rest = np.zeros((count, *SHAPES["sh_rest"]), np.float32)
    for one in range(1, degree + 1):
        rest[:, COEFFICIENTS[one - 1] : COEFFICIENTS[one]] = real[f"sh{one}"].reshape(count, 2 * one + 1, 3)
    return {
        "means": whole.grid.positions(whole.codes),
        "log_scales": real["log_scales"].astype(np.float32),
        "quats": np.concatenate([w, vectors], 1).astype(np.float32),
        "logits": real["logits"][:, 0].astype(np.float32),
        "sh_dc": real["sh_dc"].reshape(count, 1, 3).astype(np.float32),
        "sh_rest": rest,
    }


def _powers(columns: Mapping[str, Whole], steps: Mapping[str, float]) -> NDArray[np.float64]:
    """(N, 1) factors on steps of color: an error shows in proportion to opacity and the root of area.

    The logarithm of opacity is taken as that of the odds, at most 0.
    """
    by_odds, by_scale = round(_UNIT * steps["logits"]), round(_UNIT * steps["log_scales"] / 3.0)
    weight = by_odds * np.minimum(columns["logits"][:, 0], 0) + by_scale * columns["log_scales"].sum(1)
    if not len(weight):
        return np.zeros((0, 1))
    middle = np.sort(weight)[len(weight) // 2]
    octaves = np.clip((middle - weight + _OCTAVE // 2) // _OCTAVE, *COARSER)
    factors: NDArray[np.float64] = np.exp2(octaves.astype(np.float64))[:, None]
    return factors


def _turns() -> NDArray[np.float64]:
    """(24, 3, 3) rotations that put axes on axes."""
    found = []
    for places in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(places), range(3)] = signs
            if np.linalg.det(matrix) > 0.0:
                found.append(matrix)
    return np.stack(found)


def least_turn(
    log_scales: NDArray[np.float32], quats: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The same ellipsoids with their axes named so that the rotation is the least.

    Returns:
        (N, 3) scales in their new order, and (N, 3) the vectors of unit quaternions whose w is positive.
    """
    w, x, y, z = quats.astype(np.float64).T
    rotations = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    turns = _turns()
    best = np.einsum("nij,tji->nt", rotations, turns).argmax(1)
    least = rotations @ turns[best]
    # w is at least cos(31.4°), so that dividing by it is harmless.
    w = 0.5 * np.sqrt(np.maximum(1.0, 1.0 + np.trace(least, axis1=1, axis2=2)))
    pairs = ((2, 1), (0, 2), (1, 0))
    vectors = np.stack([least[:, i, j] - least[:, j, i] for i, j in pairs], 1) / (4.0 * w[:, None])
    scales = np.einsum("ni,nij->nj", log_scales.astype(np.float64), np.abs(turns[best]))
    return scales.astype(np.float32), vectors.astype(np.float32)


# --------------------------------------------------------------------------- coding


def _keys(known: Mapping[str, Whole], count: int) -> list[Whole]:
    """Numbers of each Gaussian that rank them, of the columns that are known."""
    keys = [np.zeros(count, np.int64)]
    if "log_scales" in known:
        scales = known["log_scales"]
        keys += [scales.sum(1), scales.max(1) - scales.min(1)]
    if "logits" in known:
        keys += [known["logits"][:, 0]]
    keys += [np.abs(known[name]).sum(1) for name in ("sh1", "sh2") if name in known]
    return keys


def _classes(key: Whole) -> Whole:
    """(N,) the part of the ranks that each belongs to; ties keep their order."""
    many = min(CLASSES, max(1, len(key) // _LEAST_CLASS)) if key.any() else 1  # the first key ranks nothing
    classes = np.empty(len(key), np.int64)
    classes[np.argsort(key, kind="stable")] = np.arange(len(key)) * many // max(1, len(key))
    return classes


def _encoded(columns: Whole, keys: list[Whole]) -> bytes:
    """The models of each column, then all symbols."""
    ranks = [_classes(key) for key in keys]
    models, residuals, indices = b"", [], []
    for column in columns.T:
        kinds = (column, np.diff(column, prepend=0))
        options = [(kind, key) for kind in range(len(kinds)) for key in range(len(keys))]
        kind, key = min(options, key=lambda one: _estimate(kinds[one[0]], ranks[one[1]]))
        values, classes = kinds[kind], ranks[key]
        chosen = [_fitted(values[classes == one]) for one in range(classes.max() + 1)]
        models += _COLUMN.pack(kind, key) + b"".join(_CLASS.pack(*one) for one in chosen)
        centers, tables_ = _coding(chosen, classes)
        residuals.append((values - centers).astype(np.int32))
        indices.append(tables_)
    encoder = Encoder()
    write_residuals(encoder, np.concatenate(residuals), np.concatenate(indices))
    return models + encoder.finish()


def _decoded(data: bytes, width: int, keys: list[Whole], count: int) -> Whole:
    """Inverse of :func:`_encoded`: (N, width) columns."""
    if not count:
        return np.zeros((0, width), np.int64)
    at, kinds, centers, indices = 0, [], [], []
    for _ in range(width):
        kind, key = _COLUMN.unpack_from(data, at)
        at += _COLUMN.size
        classes = _classes(keys[key])
        chosen = []
        for _ in range(classes.max() + 1):
            mean, spread = _CLASS.unpack_from(data, at)
            if spread >= SPREADS or abs(mean) > 2 * MEAN_PARTS * _WIDEST:
                raise ValueError("a model that cannot be")
            chosen.append((mean, spread))
            at += _CLASS.size
        center, tables_ = _coding(chosen, classes)
        kinds.append(kind)
        centers.append(center)
        indices.append(tables_)
    decoder = Decoder(data[at:])
    residuals = read_residuals(decoder, np.concatenate(indices)).astype(np.int64)
    decoder.finish()
    values = residuals.reshape(width, count) + np.stack(centers)
    return np.stack([np.cumsum(one) if kind else one for one, kind in zip(values, kinds, strict=True)], 1)


def _estimate(values: Whole, classes: Whole) -> float:
    """About how many bits values take: those of normal distributions."""
    counts = np.bincount(classes)
    means = np.bincount(classes, values) / counts
    variances = np.bincount(classes, np.square(values - means[classes])) / counts
    return float((counts * np.log2(np.maximum(variances, 0.1))).sum())


def _fitted(values: Whole) -> tuple[int, int]:
    """Mean in sixteenths of a step, and the spread whose tables code values in the fewest bits."""
    mean = round(MEAN_PARTS * float(values.mean()))
    residuals, counts = np.unique(values - _center(mean), return_counts=True)
    deviation = max(float(values.std()), 2.0 ** SPREAD_OCTAVES[0])
    middle = round(SPREAD_PER_OCTAVE * (np.log2(deviation) - SPREAD_OCTAVES[0]))
    spreads = np.arange(middle - 2 * SPREAD_PER_OCTAVE, middle + SPREAD_PER_OCTAVE // 2)
    spreads = np.unique(np.clip(spreads, 0, SPREADS - 1)).tolist()
    return mean, min(spreads, key=lambda one: _bits(residuals, counts, mean, one))


def _bits(residuals: Whole, counts: Whole, mean: int, spread: int) -> float:
    """What residuals cost under the table of a spread."""
    table = int(_tables(np.array([mean]), np.array([spread]))[0])
    low, frequencies = coding_table(table)
    shift, escape = low_bits(table), len(frequencies) - 1
    symbols = (residuals >> shift) - low
    outside = (symbols < 0) | (symbols >= escape)
    costs = FREQUENCY_BITS + shift - np.log2(frequencies[np.where(outside, escape, symbols)])
    costs += outside * (5.0 - shift + np.log2(2.0 * np.abs(residuals) + 2.0))
    return float((counts * costs).sum())


def _coding(chosen: list[tuple[int, int]], classes: Whole) -> tuple[Whole, NDArray[np.uint16]]:
    """(N,) centres and tables of Gaussians in their classes."""
    means, spreads = np.array(chosen, np.int64).T
    return _center(means)[classes], _tables(means, spreads)[classes]


def _center(mean: Any) -> Any:
    """Whole number next to a mean in sixteenths, which is -8 to 7 sixteenths beyond it."""
    return (mean + MEAN_PARTS // 2) // MEAN_PARTS


def _tables(means: Whole, spreads: Whole) -> NDArray[np.uint16]:
    return table_index(spreads, means - MEAN_PARTS * _center(means))
