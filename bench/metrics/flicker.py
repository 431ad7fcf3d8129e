"""Temporal stability: how the error changes from one frame to the next along a dense path of views."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera

if TYPE_CHECKING:
    from collections.abc import Iterator

DENSE = 2.0
"""Largest angle between two views that follow each other as frames do, in degrees."""


class Flicker:
    """Accumulates the flicker of frames that come one by one.

    With e the difference of a rendered frame from the truth, it is the root mean square of e(t + 1) - e(t)
    over pixels and channels, in steps of 1/255; the mean over pairs of frames. An error that stays in place
    counts nothing.

    Attributes:
        pairs: flicker of each pair so far.
    """

    def __init__(self) -> None:
        self.pairs: list[float] = []
        self._error: NDArray[np.float32] | None = None

    def add(self, truth: NDArray[np.uint8], rendered: NDArray[np.uint8]) -> None:
        """Add the next frame.

        Args:
            truth: (height, width, 3) picture as displayed.
            rendered: (height, width, 3) picture as displayed.
        """
        error = rendered.astype(np.float32) - truth
        if self._error is not None:
            self.pairs.append(math.sqrt(float(np.square(error - self._error, dtype=np.float64).mean())))
        self._error = error

    @property
    def mean(self) -> float | None:
        """Mean over pairs; None before the second frame."""
        return math.fsum(self.pairs) / len(self.pairs) if self.pairs else None


def is_dense(cameras: Sequence[Camera]) -> bool:
    """Whether every view turns by at most :data:`DENSE` degrees against the one before."""
    return len(cameras) > 1 and max(_turns(cameras)) <= DENSE


def _turns(cameras: Iterable[Camera]) -> Iterator[float]:
    """Angles between successive views, in degrees."""
    rotations = (camera.camera_to_world[:3, :3] for camera in cameras)
    for one, other in pairwise(rotations):
        cosine = 0.5 * (float(np.trace(one.T @ other)) - 1.0)
        yield math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
