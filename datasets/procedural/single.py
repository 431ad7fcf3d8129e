"""Sets of one variable: supernova, argon bubble, beetle, turbulence."""

from __future__ import annotations

import numpy as np

from econgs_bench.datasets.procedural.space import Array, Slice, Waves, smoothstep


class Supernova:
    """A wrinkled shock, a turbulent shell behind it, and a hot core with plumes."""

    def __init__(self, seed: int) -> None:
        self._coarse = Waves(seed * 17 + 1, 1.0, 5.0)
        self._fine = Waves(seed * 17 + 2, 6.0, 36.0, 1.6)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Entropy-like values in 0...1."""
        radius = np.sqrt(at.columns**2 + at.rows**2 + at.z**2)
        coarse, fine = self._coarse(at), self._fine(at)
        r = radius + (0.03 * coarse + 0.012 * fine) * smoothstep(radius, 0.0, 0.2)
        shock = 1.0 - smoothstep(r, 0.38, 0.42)
        shell = np.exp(-(((r - 0.33) / 0.06) ** 2)) * (0.35 + 0.08 * fine)
        core = 0.85 * np.exp(-((r / 0.2) ** 2) * np.exp(-0.5 * coarse))
        return {"supernova_like": shock * (0.12 + np.maximum(shell, 0.0) + core)}


class ArgonBubble:
    """A bubble rolled up into a ring with a jet, and the shock that hit it: two structures in one field."""

    def __init__(self, seed: int) -> None:
        self._coarse = Waves(seed * 19 + 1, 2.0, 8.0)
        self._fine = Waves(seed * 19 + 2, 8.0, 40.0, 1.6)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1: air 0.1, shocked air 0.3, argon above."""
        x, y = at.columns, at.rows
        fine, coarse = self._fine(at), self._coarse(at)
        from_axis = np.sqrt(y**2 + at.z**2)
        ring = np.sqrt((x + 0.08) ** 2 + (from_axis - 0.11) ** 2) + 0.010 * coarse + 0.006 * fine
        cap = np.sqrt((x - 0.02) ** 2 / 1.6 + from_axis**2 * 0.9) + 0.010 * coarse + 0.005 * fine
        shock = np.exp(-(((x - 0.33 + 0.25 * from_axis**2 + 0.006 * coarse) / 0.018) ** 2))
        bubble = np.exp(-((ring / 0.05) ** 2)) + 0.55 * np.exp(-(((cap - 0.10) / 0.03) ** 2))
        return {"argon_bubble_like": 0.04 + 0.28 * shock + 0.62 * np.minimum(bubble, 1.0)}


class Turbulence:
    """A ball of a scalar in turbulence: waves of 1 to 160 periods, whose energy falls as k^(-5/3)."""

    def __init__(self, seed: int) -> None:
        self._waves = Waves(seed * 29 + 1, 1.0, 160.0, count=768)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1, with a mean of 0.5 inside the ball."""
        radius = np.sqrt(at.columns**2 + at.rows**2 + at.z**2)
        ball = 1.0 - smoothstep(radius, 0.36, 0.48)
        return {"turbulence": (0.5 + 0.17 * self._waves(at)) * ball}


class Beetle:
    """A body with a hard hollow shell, wing cases with grooves, head, horns, six thin legs; noise of a CT."""

    def __init__(self, seed: int) -> None:
        self._grain = Waves(seed * 23 + 1, 50.0, 110.0, 1.5, 192)
        self._tissue = Waves(seed * 23 + 2, 4.0, 20.0)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1: air, soft tissue 0.25, shell 0.7."""
        x, y, z = at.columns, at.rows, at.z
        body = np.sqrt((x / 0.20) ** 2 + ((y + 0.08) / 0.30) ** 2 + (z / 0.17) ** 2)
        head = np.sqrt((x / 0.11) ** 2 + ((y - 0.28) / 0.10) ** 2 + ((z + 0.02) / 0.09) ** 2)
        groove = 0.012 * np.cos(2.0 * np.pi * x / 0.05) * (z > 0.0)
        surface = np.minimum((body - 1.0) * 0.19 + groove, (head - 1.0) * 0.095)
        shell = np.exp(-((surface / 0.010) ** 2))
        tissue = smoothstep(-surface, 0.01, 0.04) * (0.2 + 0.05 * self._tissue(at))
        legs = np.full(np.broadcast_shapes(x.shape, y.shape), np.inf)
        for side in (-1.0, 1.0):
            for start, end in ((0.16, 0.30), (0.0, 0.0), (-0.16, -0.32)):
                knee = (side * 0.34, start + 0.4 * (end - start), -0.02)
                foot = (side * 0.43, end, -0.24)
                hip = (side * 0.15, start, -0.1)
                for a, b in ((hip, knee), (knee, foot)):
                    legs = np.minimum(legs, _to_segment(x, y, z, a, b))
            legs = np.minimum(legs, _to_segment(x, y, z, (side * 0.04, 0.36, 0.0), (side * 0.12, 0.48, 0.08)))
        limb = np.exp(-((legs / 0.016) ** 2))
        value = 0.06 + np.maximum(tissue, 0.66 * np.maximum(shell, limb))
        return {"beetle_like": value + 0.02 * self._grain(at)}


def _to_segment(x: Array, y: Array, z: float, a: tuple[float, ...], b: tuple[float, ...]) -> Array:
    """Distance to the line from a to b."""
    d = [q - p for p, q in zip(a, b, strict=True)]
    t = ((x - a[0]) * d[0] + (y - a[1]) * d[1] + (z - a[2]) * d[2]) / sum(part**2 for part in d)
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(
        np.sqrt((x - a[0] - t * d[0]) ** 2 + (y - a[1] - t * d[1]) ** 2 + (z - a[2] - t * d[2]) ** 2)
    )


class Blobs:
    """A jittered lattice of Gaussian blobs: the ladder of complexity has 1, 8, 64, 512 and 4096 blobs.

    Radii shrink with the lattice, so that the sets fill the same part of the box and each blob stands alone.
    """

    def __init__(self, seed: int, across: int) -> None:
        generator = np.random.default_rng(seed * 29 + across)
        cell = 1.0 / across
        lattice = np.stack(np.meshgrid(*3 * [(np.arange(across) + 0.5) * cell - 0.5]), axis=-1).reshape(-1, 3)
        self.centres = lattice + cell * generator.uniform(-0.12, 0.12, lattice.shape)
        self._radius = 0.17 * cell * generator.uniform(0.8, 1.1, len(lattice))
        self.name = f"blobs_{across**3}"

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Sum of the blobs, each with peak 1."""
        depth = (at.z - self.centres[:, 2]) / self._radius
        near = np.abs(depth) < 5.0
        if not near.any():
            return {self.name: np.zeros((len(at.y), len(at.x)))}
        centres, radius = self.centres[near], self._radius[near]
        rows = np.exp(-0.5 * ((at.y[:, None] - centres[:, 1]) / radius) ** 2 - 0.5 * depth[near] ** 2)
        columns = np.exp(-0.5 * ((at.x[:, None] - centres[:, 0]) / radius) ** 2)
        return {self.name: rows @ columns.T}
