"""Hash grids: an independent interpolation, both backends, exactness, gradients."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.econgs.codec.hash_grid import (
    HAC_GRID,
    SMALL_GRID,
    GridConfig,
    HashGrid,
    interpolate,
    make_lookup,
)

TINY = GridConfig(volume=(3, 6, 11), planes=(5, 20), volume_log2=7, planes_log2=6)
EXTENT = (900, 1023, 65535)


def codes_of(count: int, seed: int = 0) -> torch.Tensor:
    random = np.random.default_rng(seed)
    codes = random.integers(0, np.array(EXTENT) + 1, (count, 3))
    codes[0], codes[1] = 0, EXTENT  # the corners of the box
    return torch.from_numpy(codes)


def slowly(config: GridConfig, binary: np.ndarray, code: np.ndarray) -> list[Fraction]:
    """Interpolation at one position by fractions: weights of 1/128, hashing in unsigned 32 bits."""
    values, first = [], 0
    planes = [(0, 1), (1, 2), (2, 0)]
    levels = [((0, 1, 2), size, 1 << config.volume_log2) for size in config.volume]
    levels += [(axes, size, 1 << config.planes_log2) for axes in planes for size in config.planes]
    for axes, size, most in levels:
        dense = size ** len(axes) <= most
        entries = size ** len(axes) if dense else most
        total = [Fraction(0)] * config.features
        for corner in range(1 << len(axes)):
            weight, vertex = Fraction(1), []
            for i, axis in enumerate(axes):
                place = Fraction(int(code[axis]) * (size - 1), EXTENT[axis])
                cell = min(int(place), size - 2)
                fraction = Fraction(int((place - cell) * 128 + Fraction(1, 2)), 128)
                up = corner >> i & 1
                weight *= fraction if up else 1 - fraction
                vertex.append(cell + up)
            if dense:
                at = sum(one * size**i for i, one in enumerate(vertex))
            else:
                at = 0
                for one, prime in zip(vertex, (1, 2654435761, 805459861), strict=False):
                    at ^= one * prime % 2**32
                at %= most
            for k in range(config.features):
                total[k] += weight * int(binary[first + at, k])
        values += total
        first += entries
    assert first == config.entries
    return values


def test_values_are_exactly_the_interpolation(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", "torch" if backend.name == "gsplat" else backend.name)
    grid = HashGrid(TINY, torch.Generator().manual_seed(3)).to(backend.device)
    codes = codes_of(40)
    values, _ = grid(make_lookup(TINY, codes.to(backend.device), EXTENT))
    binary = np.where(grid.table.detach().cpu().numpy() >= 0, 1, -1)
    expected = [[float(one) for one in slowly(TINY, binary, code)] for code in codes.numpy()]
    assert values.detach().cpu().tolist() == expected
    assert np.unique(np.abs(expected)).size > 100


def test_weights_sum_to_one_and_vertices_stay_in_their_level() -> None:
    lookup = make_lookup(TINY, codes_of(200), EXTENT)
    row = first = 0
    for axes, _, entries in TINY.levels:
        corners = 2 ** len(axes)
        assert (lookup.weights[row : row + corners].sum(0) == 1).all()
        index = lookup.index[row : row + corners]
        assert index.min() >= first
        assert index.max() < first + entries
        row, first = row + corners, first + entries
    assert row == len(lookup.index)


def gradients(rows: torch.Tensor, seeds: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    grid = HashGrid(SMALL_GRID, torch.Generator().manual_seed(1)).to(dtype)
    with torch.no_grad():
        grid.table[::3] *= 2e4  # some beyond 1: no gradient there
    lookup = make_lookup(SMALL_GRID, codes_of(300), EXTENT)
    if dtype == torch.float64:
        lookup = type(lookup)(lookup.index, lookup.weights.double(), lookup.config)
    values, bits = grid(lookup, rows)
    ((values * seeds).sum() + 0.01 * bits).backward()
    assert grid.table.grad is not None
    return grid.table.grad.clone()


def test_gradients_of_both_backends(splat: Any, ways: Any) -> None:
    rows = torch.from_numpy(np.random.default_rng(2).integers(0, 300, 500))
    seeds = torch.from_numpy(np.random.default_rng(3).normal(size=(500, SMALL_GRID.outputs)))
    exact = gradients(rows, seeds, torch.float64)
    by_torch, _, *by_kernels = [gradients(rows, seeds.float(), torch.float32) for _ in ways()]
    assert all(torch.equal(one, by_kernels[0]) for one in by_kernels)
    assert all(splat.relative(one.double(), exact) < 1e-6 for one in (by_torch, *by_kernels[:1]))
    grid = HashGrid(SMALL_GRID, torch.Generator().manual_seed(1)).table.detach().clone()
    grid[::3] *= 2e4
    assert (exact[grid.abs() > 1] == 0).all()
    assert (grid.abs() > 1).sum() > 1000


def test_bits_are_the_entropy_of_the_signs(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", "torch" if backend.name == "gsplat" else backend.name)
    grid = HashGrid(TINY, torch.Generator().manual_seed(0)).to(backend.device)
    with torch.no_grad():
        grid.table += 5e-5  # three quarters are +1
    _, bits = grid(make_lookup(TINY, codes_of(5).to(backend.device), EXTENT))
    expected, first = 0.0, 0
    for _, _, entries in TINY.levels:
        share = float((grid.table[first : first + entries] >= 0).double().mean())
        expected -= 4 * entries * (share * np.log2(share) + (1 - share) * np.log2(1 - share))
        first += entries
    assert bits.item() == pytest.approx(expected, rel=1e-6)
    assert expected < 0.9 * TINY.bits
    bits.backward()
    # Descending makes the frequent sign more frequent.
    assert (grid.table.grad < 0).double().mean() > 0.9


def test_sizes() -> None:
    assert HAC_GRID.outputs == 96
    assert HAC_GRID.bits == 1_766_272 - 48  # HAC fills levels up to multiples of 8 entries
    assert SMALL_GRID.outputs == 56
    assert SMALL_GRID.bits / 8 / 2**20 < 0.06


def test_what_does_not_fit_is_refused() -> None:
    lookup = make_lookup(TINY, codes_of(5), EXTENT)
    with pytest.raises(ValueError, match="another grid"):
        interpolate(torch.zeros(SMALL_GRID.entries, 4), lookup)
    with pytest.raises((ValueError, IndexError), match=r"row|out of"):
        interpolate(torch.zeros(TINY.entries, 4), lookup, torch.tensor([5]))
    with pytest.raises(ValueError, match="levels"):
        GridConfig(volume=(1,), planes=(), volume_log2=5, planes_log2=5)
    with pytest.raises(ValueError, match="tables"):
        GridConfig(volume=(8,), planes=(), volume_log2=25, planes_log2=5)


def test_no_positions(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", "torch" if backend.name == "gsplat" else backend.name)
    grid = HashGrid(TINY).to(backend.device)
    lookup = make_lookup(TINY, torch.zeros((0, 3), dtype=torch.int64, device=backend.device), EXTENT)
    values, bits = grid(lookup)
    assert values.shape == (0, TINY.outputs)
    (values.sum() + bits).backward()
    assert torch.isfinite(grid.table.grad).all()
