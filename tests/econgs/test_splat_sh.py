"""Spherical harmonics against scipy's, and their gradients on every backend."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from econgs_bench.econgs.splat import spherical_harmonics


def inputs(count: int, degree: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(seed)
    arrays = (
        random.normal(size=(count, 3)),
        np.array([3.0, -1.5, 0.5]),
        0.3 * random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    means, eye, coefficients = (torch.from_numpy(one.astype(np.float32)).double() for one in arrays)
    return means, eye, coefficients


def real_basis(degree: int, directions: np.ndarray) -> np.ndarray:
    """From scipy's complex harmonics, which carry the Condon-Shortley phase."""
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            part = value.imag if order < 0 else value.real
            columns.append(part * (np.sqrt(2) if order else 1))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_are_those_of_scipy(backend: Any, degree: int) -> None:
    means, eye, coefficients = inputs(200, degree)
    away = (means - eye).numpy()
    basis = real_basis(degree, away / np.linalg.norm(away, axis=1, keepdims=True))
    expected = np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", basis, coefficients.numpy()))
    single = (one.float().to(backend.device) for one in (means, eye, coefficients))
    actual = spherical_harmonics(degree, *single, backend=backend.name).cpu().numpy()
    assert degree < 2 or (expected == 0).any()
    np.testing.assert_allclose(actual, expected, atol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_match_float64(splat: Any, backend: Any, degree: int) -> None:
    """With coefficients for degree 3 of which only some are used, as in the schedule of 3DGS."""
    means, eye, coefficients = inputs(300, 3, seed=degree)
    seed = torch.from_numpy(np.random.default_rng(1).normal(size=(300, 3)).astype(np.float32)).double()
    # Where a color is within rounding of zero, float32 may clamp otherwise than float64.
    used = (degree + 1) ** 2
    away = torch.nn.functional.normalize(means - eye, dim=1).numpy()
    raw = 0.5 + np.einsum("nk,nkc->nc", real_basis(degree, away), coefficients[:, :used].numpy())
    seed[torch.from_numpy(abs(raw) < 1e-5)] = 0
    results = []
    for dtype, name, device in (
        (torch.float64, "torch", "cpu"),
        (torch.float32, backend.name, backend.device),
    ):
        leaves = [one.to(device, dtype, copy=True).requires_grad_(True) for one in (means, coefficients)]
        colors = spherical_harmonics(degree, leaves[0], eye.to(device, dtype), leaves[1], backend=name)
        (colors * seed.to(device, dtype)).sum().backward()
        results.append(
            [torch.zeros(300, 3) if one.grad is None else one.grad.double().cpu() for one in leaves]
        )
    (expected_means, expected), (actual_means, actual) = results
    assert (expected[:, used:] == 0).all()
    assert (actual[:, used:] == 0).all()
    assert splat.relative(actual, expected) < backend.tolerance
    if degree == 0:
        assert actual_means.abs().max() == 0
    else:
        assert splat.relative(actual_means, expected_means) < backend.tolerance


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_two_tensors_are_one(backend: Any, degree: int) -> None:
    """The first coefficient apart from the others: the same numbers, and exact zeros above the degree."""
    means, eye, coefficients = (one.float().to(backend.device) for one in inputs(77, 3))
    seed = torch.randn(77, 3, generator=torch.Generator().manual_seed(2)).to(backend.device)
    seed[::5] = 0  # not visible
    results = []
    for parts in ([coefficients], [coefficients[:, :1], coefficients[:, 1:]]):
        leaves = [one.clone().contiguous().requires_grad_(True) for one in (means, *parts)]
        colors = spherical_harmonics(degree, leaves[0], eye, *leaves[1:], backend=backend.name)
        (colors * seed).sum().backward()
        results.append([colors.detach(), *(one.grad for one in leaves)])
    (colors, to_means, joined), (same, same_means, first, rest) = results
    assert torch.equal(colors, same)
    assert torch.equal(joined[:, :1], first)
    if degree == 0:
        assert rest is None  # so that an optimiser leaves it alone
    else:
        assert torch.equal(to_means, same_means)
        assert torch.equal(joined[:, 1:], rest)
        used = (degree + 1) ** 2 - 1
        assert (rest[:, used:] == 0).all()
        assert (rest[:, :used] != 0).any()


def test_gradients_are_those_of_finite_differences() -> None:
    means, eye, coefficients = inputs(5, 3)
    coefficients = 0.2 * coefficients
    leaves = (means.requires_grad_(True), coefficients.requires_grad_(True))
    assert torch.autograd.gradcheck(lambda m, c: spherical_harmonics(3, m, eye, c), leaves)


def test_nothing_and_nowhere(backend: Any) -> None:
    """No Gaussians; and a Gaussian at the camera's own place, which has no direction."""
    means, eye, coefficients = (one.float().to(backend.device) for one in inputs(4, 3))
    none = spherical_harmonics(3, means[:0], eye, coefficients[:0], backend=backend.name)
    assert none.shape == (0, 3)
    means[2] = eye
    means.requires_grad_(True)
    coefficients.requires_grad_(True)
    colors = spherical_harmonics(3, means, eye, coefficients, backend=backend.name)
    colors.sum().backward()
    assert torch.isfinite(colors).all()
    assert torch.isfinite(means.grad).all()
    assert torch.isfinite(coefficients.grad).all()


def test_what_does_not_fit_is_refused() -> None:
    means, eye, coefficients = inputs(4, 2)
    with pytest.raises(ValueError, match="degree 4"):
        spherical_harmonics(4, means, eye, coefficients)
    with pytest.raises(ValueError, match="needs 16 coefficients, not 9"):
        spherical_harmonics(3, means, eye, coefficients)
    with pytest.raises(ValueError, match="coefficients has shape"):
        spherical_harmonics(1, means, eye, coefficients[:3])
    with pytest.raises(ValueError, match=r"not \(N, 1, 3\), beside rest"):
        spherical_harmonics(1, means, eye, coefficients, coefficients[:, 1:])
    with pytest.raises(ValueError, match="needs 9 coefficients, not 4"):
        spherical_harmonics(2, means, eye, coefficients[:, :1], coefficients[:, 1:4])
