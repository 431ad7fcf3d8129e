"""The wake of a ship-like body: four variables of one velocity field."""

from __future__ import annotations

import numpy as np

from econgs_bench.datasets.procedural.space import Array, Slice, gradient, smoothstep, vector

SIDES = (1.0, 0.6, 0.4)
VARIABLES = ("ACC", "DIV", "VLM", "VTM")
_ACC, _DIV, _VLM, _VTM = 60.0, 20.0, 2.2, 45.0


class ShipWake:
    """Flow along x around a blunt body near the left: a street of vortices and turbulence behind it.

    ACC is |(u . grad) u|, DIV the divergence (0.5 where it vanishes), VLM |u| and VTM |curl u|.
    """

    def __init__(self, seed: int) -> None:
        self._eddies = vector(seed * 13 + 3, 3.0, 16.0)

    def velocity(self, at: Slice, axis: int) -> Array:
        """One component."""
        x, y, z = at.columns + 0.3, at.rows, at.z + 0.08
        behind = smoothstep(x, 0.0, 0.15)
        width = 0.07 + 0.12 * np.clip(x, 0.0, None)
        wake = behind * np.exp(-((y / width) ** 2) - (z / (0.8 * width)) ** 2)
        turbulent = 0.55 * wake * self._eddies[axis](at)
        phase = 2.0 * np.pi * x / 0.22
        if axis == 0:
            near = np.exp(-((x / 0.07) ** 2) - (y / 0.05) ** 2 - (z / 0.07) ** 2)
            meander = 0.5 * wake * np.sin(phase) * y / width
            return np.asarray(1.0 - 0.7 * wake - 0.95 * near + turbulent - meander)
        if axis == 1:
            around = 5.0 * y * np.exp(-((x + 0.03) ** 2 + y**2 + z**2) / 0.006)
            return np.asarray(turbulent + around + 0.6 * wake * np.cos(phase))
        return np.asarray(turbulent + 4.0 * z * np.exp(-((x + 0.03) ** 2 + y**2 + z**2) / 0.006))

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1 of each variable."""
        u = [self.velocity(at, axis) for axis in range(3)]
        d = [gradient(lambda s, axis=axis: self.velocity(s, axis), at) for axis in range(3)]  # type: ignore[misc]
        acceleration = [sum(u[j] * d[i][j] for j in range(3)) for i in range(3)]
        curl = (d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1])
        return {
            "ACC": np.sqrt(sum(np.asarray(a) ** 2 for a in acceleration)) / _ACC,
            "DIV": 0.5 + (d[0][0] + d[1][1] + d[2][2]) / (2.0 * _DIV),
            "VLM": np.sqrt(sum(part**2 for part in u)) / _VLM,
            "VTM": np.sqrt(sum(part**2 for part in curl)) / _VTM,
        }
