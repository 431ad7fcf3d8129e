"""Transfer functions: named bumps of opacity over a scalar range, each with a color."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_ENTRIES = 1 << 20
"""Greatest size of a table."""
MOST_OPACITY = 0.9999
"""Greatest opacity over one reference length: at 1, extinction would be infinite."""
_PER_BUMP = 64  # the narrowest bump has this part of a table's least entries


@dataclass(frozen=True)
class Bump:
    """A trapezoid of opacity over normalised values.

    Opacity rises linearly from 0 at ``start`` to ``opacity`` at ``rise``, stays until ``fall``
    and returns to 0 at ``end``; start <= rise <= fall <= end, all in [0, 1].

    Attributes:
        name: structure of the bump ("bone").
        color: displayed sRGB color, three values in [0, 1].
        opacity: opacity in [0, 1) accumulated over one reference length of a ray (see
            :class:`TransferFunction`).
    """

    name: str
    start: float
    rise: float
    fall: float
    end: float
    color: tuple[float, float, float]
    opacity: float


@dataclass(frozen=True)
class TransferFunction:
    """A sum of bumps: opacities add (clipped below 1), colors are opacity-weighted.

    Opacity is per ``reference_length`` of scene space, so that pictures do not depend on the
    ray step (opacity correction): extinction = -ln(1 - opacity) / reference_length.

    Attributes:
        name: identifier within the dataset ("bone").
        bumps: one or more.
        reference_length: scene-space length over which ``opacity`` is reached; positive.
    """

    name: str
    bumps: tuple[Bump, ...]
    reference_length: float = 0.01

    def classify(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Exact piecewise-linear classification in float64.

        Args:
            values: any shape, normalised to [0, 1].

        Returns:
            values.shape + (4,): color in [0, 1] (straight, not premultiplied) and extinction >= 0
            per unit of scene space. A value without opacity has the color of the nearest bump, so that
            interpolation of tables does not darken edges.
        """
        x = np.asarray(values, dtype=np.float64)
        opacity = np.zeros(x.shape)
        weighted = np.zeros((*x.shape, 3))
        nearest = np.zeros((*x.shape, 3))
        best = np.full(x.shape, np.inf)
        for bump in self.bumps:
            o = bump.opacity * _trapezoid(x, bump)
            color = np.asarray(bump.color, dtype=np.float64)
            opacity += o
            weighted += o[..., None] * color
            distance = np.maximum(np.maximum(bump.start - x, x - bump.end), 0.0)
            closer = distance < best
            best = np.where(closer, distance, best)
            nearest = np.where(closer[..., None], color, nearest)
        visible = opacity > 0.0
        color = np.where(visible[..., None], weighted / np.where(visible, opacity, 1.0)[..., None], nearest)
        extinction = -np.log1p(-np.minimum(opacity, MOST_OPACITY)) / self.reference_length
        return np.concatenate([color, extinction[..., None]], axis=-1)

    @property
    def span(self) -> float:
        """Share of the values, in (0, 1], from the least that is visible to the greatest."""
        return max(b.end for b in self.bumps) - min(b.start for b in self.bumps) or 1.0

    def entries(self, least: int) -> int:
        """Size of a table that resolves the narrowest bump: ``least``, or more up to :data:`MOST_ENTRIES`."""
        narrowest = min((b.end - b.start for b in self.bumps if b.end > b.start), default=1.0)
        size = least
        while size * narrowest < least / _PER_BUMP and size < MOST_ENTRIES:
            size *= 2
        return size

    def table(self, size: int = 16384) -> NDArray[np.float32]:
        """(size, 4) float32 samples of :meth:`classify` at values i / (size - 1)."""
        return self.classify(np.linspace(0.0, 1.0, size)).astype(np.float32)


def _trapezoid(x: NDArray[np.float64], bump: Bump) -> NDArray[np.float64]:
    """1 on [rise, fall], 0 outside (start, end), linear between; a step where the two coincide."""
    up = _ramp(x, bump.start, bump.rise)
    down = 1.0 - _ramp(x, bump.fall, bump.end) if bump.end > bump.fall else (x <= bump.fall) * 1.0
    return np.asarray(np.minimum(up, down))


def _ramp(x: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    if high <= low:
        return (x >= high).astype(np.float64)
    return np.clip((x - low) / (high - low), 0.0, 1.0)
