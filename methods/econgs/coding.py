"""What quantisation does to a fit: noise, the context model and the rate in the loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from econgs.anchors.anchor_set import AnchorSet
from econgs.context.hash_grid import HAC_GRID, SMALL_GRID, Lookup
from econgs.context.model import (
    Attributes,
    Context,
    ContextConfig,
    ContextModel,
    Noise,
    Noisy,
    Rate,
    draw_sample,
)
from econgs.context.positions import PositionGrid
from methods.econgs.schedule import Schedule
from methods.interface import OptionValue

_GRIDS = {"small": SMALL_GRID, "hac": HAC_GRID}


class Coding:
    """Noise of the base steps first, of the context model's steps in the second stage.

    Args:
        options: resolved options of the spec.
        schedule: when what begins.
        generator: CPU generator of noise and samples.
    """

    def __init__(
        self,
        options: Mapping[str, OptionValue],
        schedule: Schedule,
        generator: torch.Generator,
        device: torch.device | str,
    ) -> None:
        scaling = float(options["scaling_step"])
        steps = (float(options["feature_step"]), scaling, scaling, float(options["offset_step"]))
        config = ContextConfig(
            features=int(options["features"]),
            offsets=int(options["offsets"]),
            steps=steps,
            grid=_GRIDS[str(options["grid"])],
        )
        self.schedule = schedule
        self.generator = generator
        self.model = ContextModel(config, generator).to(device)
        self.noise = Noise(generator=generator, device=device)
        self._base = torch.tensor([steps], device=device)
        self._grid: PositionGrid | None = None
        self._lookups: dict[str, Lookup] = {}

    def groups(self) -> dict[str, Sequence[Tensor]]:
        """What the optimiser trains in the second stage."""
        return {"grid": [self.model.grid.table], "head": self.model.head}

    @torch.no_grad()
    def begin(self, values: Sequence[Attributes]) -> None:
        """Start the second stage from these attributes of every scene."""
        self.model.calibrate(*values)

    def place(self, scenes: Sequence[AnchorSet]) -> None:
        """Anchors have come or gone: one grid for all scenes, so that the same place has the same context."""
        self._lookups.clear()
        positions = np.concatenate([anchors.positions.cpu().numpy() for anchors in scenes])
        self._grid = PositionGrid.lattice(scenes[0].voxel, positions)

    def apply(
        self, anchors: AnchorSet, values: Attributes, rows: Tensor, total: int, iteration: int
    ) -> tuple[Attributes, Rate | None]:
        """Attributes as the decoders are to see them in training, and the rate where it counts.

        Args:
            anchors: of the scene.
            values: of its visible anchors.
            rows: indices of those.
            total: number of anchors of all scenes.
            iteration: decides between nothing, noise of the base steps and the context model.
        """
        if not self.schedule.noisy(iteration):
            return values, None
        if not self.schedule.coded(iteration):
            return _sizes(self.model.perturb(values, self._plain(len(rows)), self.noise).values), None
        exact = self.model.coder_exact = self.schedule.exact(iteration)
        context = self.model(self.lookup(anchors), rows, draw_sample(len(rows), self.generator))
        if exact:
            rounded = self.model.round(values, context.steps)
            noisy = Noisy(rounded, rounded.of(context.sample).flat)
        else:
            noisy = self.model.perturb(values, context, self.noise)
        return _sizes(noisy.values), self.model.rate(noisy, context, anchors=total)

    def _plain(self, count: int) -> Context:
        """The base steps for all, nothing sampled."""
        base = self._base
        none = torch.empty(0, dtype=torch.int64, device=base.device)
        return Context(base.expand(count, -1), base.new_zeros(()), none, base[:0], base[:0])

    def lookup(self, anchors: AnchorSet) -> Lookup:
        """Where the scene's anchors fall in the grid, kept for reuse."""
        if anchors.key not in self._lookups:
            if self._grid is None:
                raise RuntimeError("the anchors were not placed")
            codes = torch.from_numpy(self._grid.codes(anchors.positions.cpu().numpy()))
            self._lookups[anchors.key] = self.model.lookup(codes, self._grid.extent)
        return self._lookups[anchors.key]

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint needs beside the optimiser's state."""
        return {"coding/noise": self.noise.pool, "coding/unit": self.model.unit.clone()}

    @torch.no_grad()
    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        self.noise.pool.copy_(saved["coding/noise"])
        self.model.unit.copy_(saved["coding/unit"])


def _sizes(values: Attributes) -> Attributes:
    """Noise may take a small scaling below zero, which rounding never does."""
    return values._replace(scalings=values.scalings.clamp_min(0.0))
