"""The training losses of a fit: means over stretches, since a single step sees a single view."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from econgs_bench.bench.store.records import LossPoint

STRETCHES = 50
"""Number of stretches of a fit; the end of a stage also ends one."""


class LossCurve:
    """Gathers losses step by step.

    Args:
        iterations: the budget.
    """

    def __init__(self, iterations: int) -> None:
        self._length = max(1, math.ceil(iterations / STRETCHES))
        self._points: list[LossPoint] = []
        self._stage = ""
        self._steps = self._first = self._last = 0
        self._sums: dict[str, float] = {}

    def add(self, iteration: int, stage: str, losses: Mapping[str, float]) -> None:
        """Add the losses of a step, or their means since the one before; ``iteration`` counts from 1."""
        if self._steps and (stage != self._stage or self._stretch(iteration) != self._stretch(self._last)):
            self._points.append(self._point())
            self._steps, self._sums = 0, {}
        if not self._steps:
            self._first = self._last + 1
        self._stage, self._last = stage, iteration
        self._steps += 1
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value

    @property
    def points(self) -> list[LossPoint]:
        """Means up to the last step; a part that a step lacks counts as 0 there."""
        return [*self._points, *([self._point()] if self._steps else [])]

    def state(self) -> dict[str, Any]:
        """JSON values for :meth:`resume`."""
        stretch = {"stage": self._stage, "steps": self._steps, "sums": self._sums}
        stretch |= {"first": self._first, "last": self._last}
        return {"done": [point.model_dump() for point in self._points], **stretch}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state`."""
        self._points = [LossPoint.model_validate(point) for point in state["done"]]
        self._stage, self._steps = state["stage"], state["steps"]
        self._last = state["last"]
        self._first = state.get("first", self._last - self._steps + 1)  # older checkpoints lack it
        self._sums = dict(state["sums"])

    def _stretch(self, iteration: int) -> int:
        return (iteration - 1) // self._length

    def _point(self) -> LossPoint:
        means = {name: float(f"{value / self._steps:.6g}") for name, value in self._sums.items()}
        return LossPoint(stage=self._stage, first=self._first, iteration=self._last, losses=means)
