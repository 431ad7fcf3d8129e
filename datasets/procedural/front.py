"""An ionisation front that advances along x, with shadowed fingers behind dense clumps."""

from __future__ import annotations

import numpy as np

from econgs_bench.datasets.procedural.space import Array, Slice, Waves, smoothstep

SIDES = (1.0, 992 / 2400, 992 / 2400)
VARIABLES = ("T", "H", "H+", "He", "He+", "H2", "PD")
_HYDROGEN = 0.76  # part of the mass


class IonisationFront:
    """Light from the left ionises gas; clumps shade the gas behind them, so that fingers stay neutral.

    Mass fractions of H, H+, H2 sum to 0.76, those of He, He+ and He++ (which is not written) to 0.24. Dense
    clumps recombine, and near the source helium is ionised twice. Temperature follows the ionised part and
    is highest in the thin front; PD, the particle density, is that of the compressed shell.
    """

    def __init__(self, seed: int) -> None:
        self._ripple = Waves(seed * 11 + 2, 3.0, 12.0, 1.6)
        self._fine = Waves(seed * 11 + 3, 10.0, 32.0)
        self._ripple.vectors[:, 0] *= 0.15  # shadows are long in the direction of light
        self._clumps = Waves(seed * 11 + 4, 4.0, 18.0, 1.7)

    def depth(self, at: Slice) -> Array:
        """Distance behind the front, positive on the neutral side."""
        fingers = self._ripple(at)
        reach = 0.05 * fingers + 0.06 * np.maximum(fingers, 0.0) ** 2 + 0.012 * self._fine(at)
        return np.asarray(at.columns - 0.02 + reach)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1 of each variable; mass fractions keep their values."""
        behind = self.depth(at)
        clumps = self._clumps(at)
        front = 1.0 - smoothstep(behind, -0.03, 0.03)
        ionised = front * (1.0 - 0.35 * smoothstep(clumps, 0.5, 2.5))
        # Helium needs harder light: it lags, the second ionisation more.
        once = 1.0 - smoothstep(behind + 0.03 * clumps, -0.16, 0.0)
        twice = 1.0 - smoothstep(behind + 0.04 * clumps, -0.42, -0.16)
        molecular = 0.8 * smoothstep(behind + 0.03 * clumps, 0.05, 0.25)
        neutral = 1.0 - ionised
        molecules = neutral * molecular
        heat = 0.06 + 0.5 * front + 0.3 * np.exp(-((behind / 0.03) ** 2)) + 0.05 * front * clumps
        heat = heat + 0.1 * np.exp(-(((behind - 0.1) / 0.05) ** 2))
        shell = np.exp(-(((behind - 0.05) / 0.035) ** 2))
        density = 0.08 + 0.12 * neutral * np.exp(0.7 * clumps) + 0.4 * shell * np.exp(0.35 * clumps)
        return {
            "T": heat,
            "H": _HYDROGEN * (neutral - molecules),
            "H+": _HYDROGEN * ionised,
            "He": (1.0 - _HYDROGEN) * (1.0 - once),
            "He+": (1.0 - _HYDROGEN) * once * (1.0 - twice),
            "H2": _HYDROGEN * molecules,
            "PD": density,
        }
