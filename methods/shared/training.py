"""What the trainers here have in common: the loop over iterations and the state they go on from."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs.optim import Adam
from methods.interface import Checkpoint, Diverged, Monitor
from methods.shared.schedule import Proportional

CHECK_EVERY = 100
"""Iterations between looks at whether parameters are finite."""
_LOGARITHMS = ("log_scales", "log_scalings")  # may be finite where their exponentials are not


class TrainingLoop(ABC):
    """A fit that takes one view at a time and goes on bit for bit from a checkpoint.

    Args:
        seed: of the one generator that every choice is drawn from.
        device: "cpu" or "cuda".

    Attributes:
        optimiser: holds the parameters.
        schedule: fitted to the budget.
        iteration: how many were done.
        pending: views not yet drawn in this round.
        limited: growth has met its limit.
    """

    optimiser: Adam
    schedule: Proportional

    def __init__(self, seed: int, device: str) -> None:
        self.device = device
        self.generator = torch.Generator().manual_seed(seed)
        self.iteration = 0
        self.pending: list[Any] = []
        self.limited = False

    @property
    def iterations(self) -> int:
        """The whole budget."""
        return self.schedule.iterations

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of primitives."""

    @property
    def may_pause(self) -> bool:
        """Whether a checkpoint can be taken after this iteration."""
        return True

    @abstractmethod
    def step(self) -> Mapping[str, float]:
        """One step of the optimiser on one view, and what the schedule adds to it.

        Returns:
            The loss ("loss") and its parts.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """

    @abstractmethod
    def model(self) -> Any:
        """The present state as a model of its own."""

    @abstractmethod
    def _round(self) -> list[Any]:
        """Every view in a new random order, the first one last."""

    @abstractmethod
    def _stage(self) -> str:
        """Name of the stage that the next iteration belongs to, for people."""

    def run(self, monitor: Monitor) -> None:
        """Train to the end of the budget.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        stage = ""
        while self.iteration < self.iterations:
            if stage != (stage := self._stage()):
                monitor.stage(stage)
            losses = self.step()
            monitor.progress(self.iteration, losses, self.count)
            if self.may_pause and monitor.due(self.iteration):
                monitor.pause(self.iteration, self.model, self.checkpoint)
        self._check_finite()

    def _shown(self, losses: Mapping[str, Tensor]) -> dict[str, float]:
        """Parts of the loss as numbers."""
        shown = {name: float(part.detach()) for name, part in losses.items()}
        for name, value in shown.items():
            if not math.isfinite(value):
                raise Diverged(f"the {name} loss is {value} at iteration {self.iteration}")
        return shown

    @torch.no_grad()
    def _check_finite(self) -> None:
        for name, group in self.optimiser.parameters.items():
            for tensor in group:
                values = tensor.exp() if name.endswith(_LOGARITHMS) else tensor
                if not math.isfinite(float(values.sum())):
                    raise Diverged(f"{name} hold NaN or infinite values at iteration {self.iteration}")

    def _next_view(self) -> Any:
        """Views come in random order, none twice before all were seen."""
        if not self.pending:
            self.pending = self._round()
        return self.pending.pop()

    def _order(self, count: int) -> list[int]:
        order: list[int] = torch.randperm(count, generator=self.generator).tolist()
        return order

    def checkpoint(self) -> Checkpoint:
        """All that :meth:`restore` needs to go on as if nothing had happened."""
        arrays = {f"optimiser/{name}": values.clone() for name, values in self.optimiser.state().items()}
        arrays["generator"] = self.generator.get_state()
        return Checkpoint(self.iteration, arrays, {"pending": list(self.pending), "limited": self.limited})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same fit."""
        self.optimiser.load_state(under("optimiser/", self.arrays(checkpoint)))
        self.generator.set_state(checkpoint.arrays["generator"].cpu())
        self.pending = list(checkpoint.scalars["pending"])
        self.limited = bool(checkpoint.scalars["limited"])
        self.iteration = checkpoint.iteration

    def arrays(self, checkpoint: Checkpoint) -> dict[str, Tensor]:
        """Arrays of a checkpoint on the device of the fit."""
        return {name: values.to(self.device) for name, values in checkpoint.arrays.items()}


def to_numpy(tensor: Tensor) -> NDArray[np.float32]:
    """A copy as float32 array."""
    return tensor.detach().cpu().numpy().copy()


def under(prefix: str, arrays: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): v for name, v in arrays.items() if name.startswith(prefix)}
