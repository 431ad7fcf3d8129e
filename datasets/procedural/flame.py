"""A turbulent planar jet flame: five variables of one mixing field."""

from __future__ import annotations

import numpy as np

from econgs_bench.datasets.procedural.space import Array, Slice, Waves, gradient, vector

SIDES = (2 / 3, 1.0, 1 / 6)
VARIABLES = ("MF", "CHI", "HR", "VORT", "OH")
_STOICHIOMETRIC = -0.1  # of MF in -1...1
_CHI, _VORT = 2500.0, 60.0  # values that map to 1


class JetFlame:
    """Fuel (MF = 1) streams along y between two streams of oxidiser (MF = -1); eddies wrinkle the layers.

    From the nozzle at the lower end the jet widens, and its layers thicken and get rougher. CHI is
    proportional to the squared gradient of MF, VORT to the magnitude of the velocity's curl. Heat is
    released in a thin layer at the stoichiometric value, less where dissipation is high (quenching); the
    products (OH) lie in a thicker layer on the lean side of it.
    """

    def __init__(self, seed: int) -> None:
        self._eddies = vector(seed * 7 + 1, 1.5, 9.0)
        self._fine = Waves(seed * 7 + 5, 5.0, 16.0)

    def velocity(self, at: Slice, axis: int) -> Array:
        """One component: eddies that live in the jet, on a mean flow along y."""
        along = at.rows + 0.5
        inside = np.exp(-((at.columns / (0.08 + 0.16 * along)) ** 2))
        mean = np.exp(-((at.columns / (0.05 + 0.10 * along)) ** 2)) if axis == 1 else 0.0
        return np.asarray((0.35 + 0.65 * along) * inside * self._eddies[axis](at) + mean)

    def mixture(self, at: Slice) -> Array:
        """MF in -1...1."""
        along = at.rows + 0.5
        rough = 0.2 + 1.0 * along
        shift = 0.05 * rough * self._eddies[0](at)
        width = 0.06 + 0.07 * along + 0.03 * rough * self._eddies[1](at)
        distance = np.sqrt((at.columns + shift) ** 2 + 1e-4)
        core = np.tanh((width - distance) / (0.035 + 0.055 * along))
        # Fine eddies act only where fuel and oxidiser meet.
        fine = 0.3 * rough * (1.0 - core**2) * self._fine(at)
        return np.asarray(np.tanh(1.2 * core + fine) / np.tanh(1.2))

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1 of each variable."""
        mixture = self.mixture(at)
        dissipation = sum(part**2 for part in gradient(self.mixture, at))
        u, v, w = (gradient(lambda s, axis=axis: self.velocity(s, axis), at) for axis in range(3))  # type: ignore[misc]
        curl = np.sqrt((w[1] - v[2]) ** 2 + (u[2] - w[0]) ** 2 + (v[0] - u[1]) ** 2)
        burning = 1.0 / (1.0 + dissipation / (1.0 * _CHI))
        heat = np.exp(-(((mixture - _STOICHIOMETRIC) / 0.18) ** 2)) * burning
        products = np.exp(-(((mixture - _STOICHIOMETRIC + 0.3) / 0.3) ** 2)) * burning**0.5
        return {
            "MF": 0.5 * (np.clip(mixture, -1.0, 1.0) + 1.0),
            "CHI": np.asarray(dissipation) / _CHI,
            "HR": heat,
            "VORT": curl / _VORT,
            "OH": products,
        }
