"""The two oldest sets (recorded figures depend on them): tangled vortex lines and dented shells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MODES = 8
"""Largest wave number, in periods per box."""
_CORE = 0.02
"""Radius at which the value of a vortex core is one half, as a part of the box."""


def vortices(n: int, seed: int) -> NDArray[np.float64]:
    """Closeness to the vortex lines of a random complex wave field: thin, tangled tubes.

    A complex field psi of random modes has zeros along curves, around which its phase winds: the vortex
    lines of a turbulent superfluid. |psi| / |grad psi| is the distance to such a line to first order, so
    1 / (1 + distance^2 / core^2) is the density deficit of a core of constant radius.
    """
    k = np.arange(-_MODES, _MODES + 1)
    kz, ky, kx = np.meshgrid(k, k, k, indexing="ij")
    length = np.sqrt(kx**2 + ky**2 + kz**2)
    # An energy spectrum of k^(-5/3) over shells of area k^2 makes amplitudes of k^(-11/6).
    inside = (length > 0.0) & (length <= _MODES)
    amplitude = np.where(inside, np.maximum(length, 1.0) ** (-11.0 / 6.0), 0.0)
    generator = np.random.default_rng(seed)
    modes = amplitude * (
        generator.standard_normal(length.shape) + 1j * generator.standard_normal(length.shape)
    )
    waves = np.exp(2j * np.pi * np.linspace(0.0, 1.0, n)[:, None] * k)
    magnitude = _square(modes, waves)
    slope = _square(2j * np.pi * kx * modes, waves)
    for axis in (ky, kz):
        slope += _square(2j * np.pi * axis * modes, waves)
    # Both real and imaginary part change across a line: the mean of their slopes is the distance's.
    distance2 = 2.0 * magnitude / np.maximum(slope, np.finfo(np.float64).tiny)
    return np.asarray(1.0 / (1.0 + distance2 / _CORE**2))


def _square(modes: NDArray[np.complex128], waves: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Squared magnitude on the grid of the sum of modes (kz, ky, kx), one axis after the other."""
    rows = modes @ waves.T  # (kz, ky, x)
    planes = np.swapaxes(np.swapaxes(rows, 1, 2) @ waves.T, 1, 2)  # (kz, y, x)
    out = np.empty((len(waves),) * 3)
    flat = planes.reshape(len(modes), -1)
    for z, wave in enumerate(waves):  # slice by slice, without a complex volume in memory
        field = wave @ flat
        out[z] = (field.real**2 + field.imag**2).reshape(out.shape[1:])
    return out


def shells(n: int, seed: int) -> NDArray[np.float64]:
    """One minus a radius that is wobbled differently at each depth: level sets are nested, dented shells."""
    generator = np.random.default_rng(seed)
    at = np.linspace(-1.0, 1.0, n)
    x, y, z = at[None, None, :], at[None, :, None], at[:, None, None]
    radius = np.sqrt(x**2 + y**2 + z**2)
    wobble = np.zeros((n, n, n))
    for _ in range(12):
        direction = generator.standard_normal(3)
        direction *= generator.uniform(4.0, 10.0) / np.linalg.norm(direction)
        phase = generator.uniform(0.0, 2.0 * np.pi)
        wobble += np.sin(direction[0] * x + direction[1] * y + direction[2] * z + phase)
    # The wobble vanishes at the centre, and the field outside the ball of radius 1 is empty.
    return np.asarray(np.maximum(1.0 - radius - 0.035 * wobble * np.minimum(2.0 * radius, 1.0), 0.0))
