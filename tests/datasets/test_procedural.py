"""Procedural volumes: the same field at any resolution, and with the structure they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from econgs_bench.datasets import procedural
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.volume import Volume


def _first(name: str, n: int, seed: int = 0) -> Volume:
    return next(iter(procedural.make_volumes(name, n, seed).values()))


def _doubles(name: str, n: int) -> bool:
    if name not in procedural._FAMILIES:
        return True
    family = procedural._FAMILIES[name]
    return all(2 * a - 1 == b for a, b in zip(family.dims(n), family.dims(2 * n - 1), strict=True))


@pytest.mark.parametrize("name", procedural.FIELDS)
def test_same_field_at_any_resolution(name: str) -> None:
    # Sides are whole numbers of steps, at both resolutions, only for some numbers of samples.
    n = next(n for n in range(13, 40) if _doubles(name, n))
    coarse, fine = _first(name, n), _first(name, 2 * n - 1)
    difference = coarse.values.astype(int) - fine.values[::2, ::2, ::2].astype(int)
    assert np.abs(difference).max() <= 1


@pytest.mark.parametrize("name", procedural.FIELDS)
def test_deterministic_by_seed(name: str) -> None:
    first, again, other = (_first(name, 24, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.values, again.values)
    assert np.corrcoef(first.values.reshape(-1), other.values.reshape(-1))[0, 1] < 0.99


def test_vortex_values_peak_on_the_zeros_of_the_wave_field() -> None:
    # Independent of the separable sums: the waves added one by one at a few points.
    k = np.arange(-8, 9)
    kz, ky, kx = np.meshgrid(k, k, k, indexing="ij")
    length = np.sqrt(kx**2 + ky**2 + kz**2)
    amplitude = np.where((length > 0) & (length <= 8), np.maximum(length, 1) ** (-11 / 6), 0)
    generator = np.random.default_rng(3)
    modes = amplitude * (
        generator.standard_normal(length.shape) + 1j * generator.standard_normal(length.shape)
    )
    vectors = np.stack([kx, ky, kz], axis=-1)
    volume = _first("vortices", 21, seed=3)
    for z, y, x in [(0, 0, 0), (3, 11, 20), (17, 5, 8)]:
        at = np.array([x, y, z]) / 20
        waves = modes * np.exp(2j * np.pi * vectors @ at)
        psi = waves.sum()
        slope = np.linalg.norm((2j * np.pi * vectors * waves[..., None]).sum(axis=(0, 1, 2)))
        expected = 1 / (1 + 2 * abs(psi) ** 2 / slope**2 / 0.02**2)
        assert volume.normalised()[z, y, x] == pytest.approx(expected, abs=2e-5)


def test_vortices_are_thin_and_shells_are_nested() -> None:
    vortices = _first("vortices", 64).normalised()
    assert 0.01 < (vortices > 0.5).mean() < 0.15
    shells = _first("shells", 48).normalised()
    for level in (0.12, 0.3, 0.6):
        _, parts = ndimage.label(shells > level)
        assert parts == 1
    assert shells[0, 0, 0] == 0.0


@pytest.mark.parametrize("resolution", [0, -1, 7, 4096])
def test_absurd_resolutions(resolution: int) -> None:
    with pytest.raises(DataError, match="out of range"):
        procedural.make_volumes("vortices", resolution)
