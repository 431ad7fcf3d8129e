"""Positions: their grid, the Morton curve and the octree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from econgs_bench.econgs.codec.positions import (
    PositionGrid,
    decode_positions,
    encode_positions,
    morton,
    morton_order,
    unmorton,
)


def grid_of(*extent: int) -> PositionGrid:
    x, y, z = extent
    return PositionGrid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (x, y, z))


def test_morton_places() -> None:
    codes = np.random.default_rng(0).integers(0, 65536, (500, 3))
    expected = [
        sum(((int(c[axis]) >> bit) & 1) << (3 * bit + axis) for bit in range(16) for axis in range(3))
        for c in codes
    ]
    assert morton(codes).tolist() == expected
    assert (unmorton(morton(codes)) == codes).all()


@settings(deadline=None, max_examples=60)
@given(
    st.tuples(*[st.sampled_from([1, 2, 7, 1000, 65535])] * 3),
    arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(0, 1)),
)
def test_positions_come_back(extent: tuple[int, int, int], places: np.ndarray) -> None:
    """Duplicates and borders included."""
    grid = grid_of(*extent)
    codes = np.rint(places * extent).astype(np.int64)
    codes = codes[morton_order(codes)]
    data = encode_positions(codes, grid)
    decoded = decode_positions(data, len(codes), grid)
    assert (decoded == codes).all()
    with pytest.raises(ValueError, match=r"positions|points"):
        decode_positions(data, len(codes) + 1, grid)


def test_many_positions_in_few_bits() -> None:
    """A wavy sheet on a lattice of 10 bits, as anchors on a surface are, and anchors strewn anywhere."""
    random = np.random.default_rng(1)
    x, y = random.integers(0, 1000, (2, 12_000))
    z = np.rint(500 + 300 * np.sin(x / 200) * np.cos(y / 150)).astype(np.int64)
    sheet = np.unique(np.stack([x, y, z], 1), axis=0)
    strewn = np.unique(random.integers(0, 1000, (12_000, 3)), axis=0)
    grid = grid_of(1000, 1000, 1000)
    bits = {}
    for name, codes in (("sheet", sheet), ("strewn", strewn)):
        codes = codes[morton_order(codes)]
        data = encode_positions(codes, grid)
        assert (decode_positions(data, len(codes), grid) == codes).all()
        bits[name] = 8 * len(data) / len(codes)
    # Strewn points: a set of N among M cells takes log2(M / N) + 1.44 bits each.
    floor = np.log2(1001**3 / len(strewn)) + 1.44
    assert floor < bits["strewn"] < floor + 0.8
    assert bits["sheet"] < bits["strewn"] - 4


def test_unsorted_positions_are_refused() -> None:
    with pytest.raises(ValueError, match="sorted"):
        encode_positions(np.array([[5, 5, 5], [0, 0, 0]]), grid_of(9, 9, 9))


def test_lattice_loses_nothing() -> None:
    """Anchors lie on multiples of the voxel size."""
    voxel = 0.001
    points = (np.random.default_rng(0).integers(-500, 500, (400, 3)) * voxel).astype(np.float32)
    grid = PositionGrid.lattice(voxel, points)
    codes = grid.codes(points)
    assert (codes.min(0) == 0).all()
    assert (codes.max(0) == grid.extent).all()
    np.testing.assert_allclose(grid.positions(codes), points, atol=1e-7)
    assert (grid.codes(grid.positions(codes)) == codes).all()
    assert grid.bits == 10


def test_box_holds_sixteen_bits() -> None:
    points = np.random.default_rng(0).uniform(-0.6, 0.4, (300, 3))
    grid = PositionGrid.box(points.min(0), points.max(0))
    away = np.abs(grid.positions(grid.codes(points)) - points)
    assert (away <= 0.5001 * np.asarray(grid.cell) + 1e-7).all()
    assert grid.bits == 16


def test_odd_grids() -> None:
    assert PositionGrid.lattice(0.1, np.zeros((0, 3))).extent == (1, 1, 1)
    flat = PositionGrid.lattice(0.5, [[1.0, 2.0, 3.0], [4.0, 2.0, 3.0]])
    assert flat.extent == (6, 1, 1)
    wide = PositionGrid.lattice(1e-6, [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert wide.extent == (65535,) * 3  # a lattice too fine becomes the box
    for bad in (((0.0, 0.0, float("nan")), (1.0,) * 3, (1, 1, 1)), ((0.0,) * 3, (0.0, 1.0, 1.0), (1, 1, 1))):
        with pytest.raises(ValueError, match="grid of positions"):
            PositionGrid(*bad)
    with pytest.raises(ValueError, match="cells per axis"):
        grid_of(70_000, 1, 1)
