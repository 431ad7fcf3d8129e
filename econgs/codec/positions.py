"""Anchor positions: whole numbers on a grid, sorted along a Morton curve and coded as an octree.

Every node's eight children are flags, coded level by level with adaptive integer frequencies. The context of
a flag: the child's place, the number of earlier siblings that are occupied, the number of occupied nodes
among the three that it touches outside its own, and whether its node is an only child. Counts change after
blocks of nodes, so that a few calls code a block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from econgs_bench.econgs.codec.coder import Decoder, Encoder, flag_models

AXIS_BITS = 16
EXTENT_LIMIT = (1 << AXIS_BITS) - 1
_FIRST_BLOCK, _LAST_BLOCK = 32, 8192
_MEMORY = 48  # limit of a context's counts at the start of a level
_CONTEXTS = 8 * 4 * 4 * 2

Codes = NDArray[np.int64]


@dataclass(frozen=True)
class PositionGrid:
    """Places of whole-number codes: origin + code · cell, in float64, rounded to float32.

    Attributes:
        origin: place of code 0, scene units.
        cell: side of a cell per axis, > 0.
        extent: largest code per axis, 1 to 65535.
    """

    origin: tuple[float, float, float]
    cell: tuple[float, float, float]
    extent: tuple[int, int, int]

    def __post_init__(self) -> None:
        sizes = np.abs([*self.origin, *self.cell])
        if not (np.isfinite(sizes).all() and sizes.max() < 1e30 and min(self.cell) > 0.0):
            raise ValueError("a grid of positions needs a finite origin and cells of positive size")
        if not all(1 <= one <= EXTENT_LIMIT for one in self.extent):
            raise ValueError(f"a grid of positions spans 1 to {EXTENT_LIMIT} cells per axis")

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike) -> PositionGrid:
        """Grid of 16 bits per axis in a box (as HAC stores positions)."""
        first, last = (np.asarray(one, np.float64).reshape(3) for one in (low, high))
        sizes = np.maximum(last - first, 1e-9) / EXTENT_LIMIT
        return cls(_three(first), _three(sizes), (EXTENT_LIMIT,) * 3)

    @classmethod
    def lattice(cls, voxel: float, positions: ArrayLike) -> PositionGrid:
        """The anchors' own lattice, multiples of ``voxel``: lossless, with fewer bits.

        Falls back to :meth:`box` if the lattice has more than 65536 cells along an axis.
        """
        points = np.asarray(positions, np.float64).reshape(-1, 3)
        if not len(points):
            return cls((0.0, 0.0, 0.0), (voxel,) * 3, (1, 1, 1))
        whole = np.rint(points / voxel)
        first, extent = whole.min(0), np.maximum(np.ptp(whole, axis=0), 1.0)
        if extent.max() > EXTENT_LIMIT:
            return cls.box(points.min(0), points.max(0))
        spans = extent.astype(int).tolist()
        return cls(_three(first * voxel), (voxel,) * 3, (spans[0], spans[1], spans[2]))

    def codes(self, positions: ArrayLike) -> Codes:
        """(N, 3) codes nearest to positions; those outside go to the border."""
        points = np.asarray(positions, np.float64).reshape(-1, 3)
        return np.clip(np.rint((points - self.origin) / self.cell), 0, self.extent).astype(np.int64)

    def holds(self, positions: ArrayLike) -> bool:
        """Whether all positions lie within the grid."""
        points = np.asarray(positions, np.float64).reshape(-1, 3)
        whole = np.rint((points - self.origin) / self.cell)
        return bool(((whole >= 0) & (whole <= self.extent)).all())

    def positions(self, codes: Codes) -> NDArray[np.float32]:
        """(N, 3) positions of codes."""
        places: NDArray[np.float64] = np.asarray(self.origin) + codes * np.asarray(self.cell)
        return places.astype(np.float32)

    @property
    def bits(self) -> int:
        """Levels of the octree: bits of the largest code."""
        return max(self.extent).bit_length()


def _three(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _dilate(values: Codes) -> Codes:
    """Dilate a 16-bit number: its bits go to every third place."""
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):  # fmt: skip
        values = (values | (values << shift)) & mask
    return values


def _contract(values: Codes) -> Codes:
    """Inverse of :func:`_dilate`."""
    values = values & 0x1249249249249249
    for shift, mask in ((2, 0x10C30C30C30C30C3), (4, 0x100F00F00F00F00F), (8, 0x1F0000FF0000FF),
                        (16, 0x1F00000000FFFF), (32, 0xFFFF)):  # fmt: skip
        values = (values | (values >> shift)) & mask
    return values


def morton(codes: Codes) -> Codes:
    """(N,) place along the Morton curve of (N, 3) codes below 2^16: bits x, y, z interleaved, x lowest."""
    x, y, z = (_dilate(codes[:, axis].astype(np.int64)) for axis in range(3))
    return x | y << 1 | z << 2


def unmorton(places: Codes) -> Codes:
    """Inverse of :func:`morton`."""
    return np.stack([_contract(places >> axis) for axis in range(3)], 1)


class _Adaptive:
    """Counts of zeros and ones per context."""

    def __init__(self) -> None:
        self.counts = np.zeros((_CONTEXTS, 2), np.int64)

    def models(self) -> NDArray[np.float64]:
        """Models of every context (Krichevsky and Trofimov's estimate)."""
        zeros, ones = self.counts.T
        return flag_models(np.clip((2 * ones + 1 << 16) // (2 * (zeros + ones) + 2), 24, 65536 - 24))

    def add(self, contexts: Codes, flags: NDArray) -> None:
        self.counts[:, 0] += np.bincount(contexts[flags == 0], minlength=_CONTEXTS)
        self.counts[:, 1] += np.bincount(contexts[flags == 1], minlength=_CONTEXTS)

    def next_level(self) -> None:
        totals = np.maximum(self.counts.sum(1, keepdims=True), _MEMORY)
        self.counts = self.counts * _MEMORY // totals


def _touching(nodes: Codes, level: int) -> NDArray[np.int8]:
    """(n, 8) number of occupied nodes among the three that each child touches outside its own."""
    every = _dilate(np.array([(1 << level) - 1], np.int64))[0]
    occupied = []
    for axis in range(3):
        mask = every << axis
        rest = nodes & ~mask
        below = ((nodes & mask) - (1 << axis)) & mask | rest
        above = ((nodes | ~mask) + (1 << axis)) & mask | rest
        for neighbours in (below, above):
            at = np.minimum(np.searchsorted(nodes, neighbours), len(nodes) - 1)
            occupied.append(nodes[at] == neighbours)
    child = np.arange(8)
    total = np.zeros((len(nodes), 8), np.int8)
    for axis in range(3):
        total += np.stack(occupied[2 * axis : 2 * axis + 2], 1)[:, child >> axis & 1]
    return total


def _blocks(count: int) -> list[tuple[int, int]]:
    spans, begin, size = [], 0, _FIRST_BLOCK
    while begin < count:
        spans.append((begin, min(begin + size, count)))
        begin, size = begin + size, min(4 * size, _LAST_BLOCK)
    return spans


def _level(
    coder: Encoder | Decoder,
    model: _Adaptive,
    nodes: Codes,
    alone: NDArray[np.bool_],
    level: int,
    children: Codes | None,
    limit: int,
) -> Codes:
    """Code the children of all nodes of a level; an encoder gets them, both coders return them."""
    touching = _touching(nodes, level)
    occupied = np.zeros((len(nodes), 8), np.bool_)
    if children is not None:
        parents = np.searchsorted(nodes, children >> 3)
        occupied[parents, children & 7] = True
    occupied_count = 0
    for begin, end in _blocks(len(nodes)):
        flags, neighbours, only = occupied[begin:end], touching[begin:end], alone[begin:end]
        before = np.zeros(end - begin, np.int64)
        models = model.models()
        coded: list[tuple[Codes, NDArray]] = []
        for child in range(8):
            contexts = ((before * 4 + neighbours[:, child]) * 8 + child) * 2 + only
            rows = np.flatnonzero(before > 0) if child == 7 else slice(None)  # a node has a child
            row_contexts = contexts[rows]
            if isinstance(coder, Encoder):
                coder.flags(flags[rows, child], models[row_contexts])
            else:
                if child == 7:
                    flags[:, child] = True
                flags[rows, child] = coder.flags(models[row_contexts]) == 1
            coded.append((row_contexts, flags[rows, child]))
            before = np.minimum(before + flags[:, child], 3)
        model.add(*(np.concatenate(part) for part in zip(*coded, strict=True)))
        occupied_count += int(flags.sum())
        if occupied_count > limit:
            raise ValueError("more points than announced")
    rows, places = np.nonzero(occupied)
    return nodes[rows] << 3 | places


def encode_positions(codes: Codes, grid: PositionGrid) -> bytes:
    """Code (N, 3) codes in Morton order (:func:`morton_order`); N ≥ 1."""
    places = morton(codes)
    if len(places) == 0 or (np.diff(places) < 0).any():
        raise ValueError("positions must be sorted along the Morton curve, and at least one")
    unique, counts = np.unique(places, return_counts=True)
    encoder = Encoder()
    _walk(encoder, grid.bits, unique, len(unique))
    repeated = counts > 1
    many = int(repeated.sum())
    encoder.raw(np.array([many]), 32)
    if many:
        encoder.flags(repeated, _repeat_models(many, len(unique)))
        encoder.raw(counts[repeated], 32)
    return encoder.finish()


def decode_positions(data: bytes, count: int, grid: PositionGrid) -> Codes:
    """(count, 3) codes in Morton order.

    Raises:
        ValueError: the data do not hold ``count`` positions of this grid.
    """
    decoder = Decoder(data)
    unique = _walk(decoder, grid.bits, None, count)
    counts = np.ones(len(unique), np.int64)
    many = int(decoder.raw(1, 32)[0])
    if many:
        if many > len(unique):
            raise ValueError("more repeated positions than positions")
        repeated = decoder.flags(_repeat_models(many, len(unique))) == 1
        counts[repeated] = decoder.raw(int(repeated.sum()), 32)
    decoder.finish()
    if counts.sum() != count:
        raise ValueError(f"{counts.sum()} positions where {count} were announced")
    codes = unmorton(np.repeat(unique, counts))
    if (codes > np.asarray(grid.extent)).any():
        raise ValueError("a position outside its grid")
    return codes


def write_plain_positions(codes: Codes, grid: PositionGrid) -> bytes:
    """The positions of (N, 3) codes as float32, not coded."""
    return grid.positions(codes).astype("<f4").tobytes()


def read_plain_positions(data: bytes, count: int, grid: PositionGrid) -> Codes:
    """(count, 3) codes in Morton order.

    Raises:
        ValueError: the data are not ``count`` positions of this grid in Morton order.
    """
    if len(data) != 12 * count:
        raise ValueError(f"{len(data)} bytes where {count} positions were announced")
    positions = np.frombuffer(data, "<f4").reshape(count, 3)
    if not np.isfinite(positions).all():
        raise ValueError("a value that is not finite")
    codes = grid.codes(positions)
    if (grid.positions(codes) != positions).any():
        raise ValueError("a position off its grid")
    if (np.diff(morton(codes)) < 0).any():
        raise ValueError("positions out of order")
    return codes


def _repeat_models(part: int, whole: int) -> NDArray[np.float64]:
    return flag_models(np.full(whole, min(max((part << 16) // whole, 1), 65535)))


def _walk(coder: Encoder | Decoder, bits: int, leaves: Codes | None, limit: int) -> Codes:
    """Code all levels from the root; an encoder gets the leaves."""
    nodes, alone = np.zeros(1, np.int64), np.zeros(1, np.bool_)
    model = _Adaptive()
    for level in range(bits):
        level_nodes = None
        if leaves is not None:
            level_nodes = leaves >> 3 * (bits - level - 1)
            level_nodes = level_nodes[np.diff(level_nodes, prepend=-1) > 0]
        children = _level(coder, model, nodes, alone, level, level_nodes, limit)
        parents = children >> 3
        same = np.diff(parents) == 0
        alone = ~(np.append(same, False) | np.append(False, same)) if len(children) else np.zeros(0, np.bool_)
        nodes = children
        model.next_level()
    return nodes


def morton_order(codes: Codes) -> NDArray[np.int64]:
    """(N,) indices that sort codes along the Morton curve; equal ones keep their order."""
    return np.argsort(morton(codes), kind="stable")
