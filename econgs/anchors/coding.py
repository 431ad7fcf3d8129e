"""Quantisation in a fit: noise, the context model and bits in the loss (HAC)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from econgs_bench.econgs.anchors.anchor_set import AnchorSet
from econgs_bench.econgs.codec.hash_grid import Lookup
from econgs_bench.econgs.codec.model import (
    Attributes,
    Context,
    ContextConfig,
    ContextModel,
    MeanBits,
    Noise,
    Noisy,
    draw_sample,
)
from econgs_bench.econgs.codec.positions import PositionGrid


class Phases(Protocol):
    """Phases of a fit; iterations count from 1."""

    def noisy(self, iteration: int) -> bool:
        """Whether attributes carry quantisation noise."""

    def coded(self, iteration: int) -> bool:
        """Whether steps and probabilities come from the context model, and bits count."""

    def exact(self, iteration: int) -> bool:
        """Whether attributes are rounded as in the coder."""


class Coding:
    """Quantisation noise: from the base steps at first, from the context model's steps in the second stage.

    Args:
        config: sizes of the context model.
        schedule: phases of the fit.
        generator: CPU generator of noise and samples.
        margin: margin of the grid of positions round the anchors, as a share of their box: the grid stays
            while they grow within it. 0: each growth event makes a new grid.
        sample: share of the visible anchors whose bits count in an iteration.
    """

    def __init__(
        self,
        config: ContextConfig,
        schedule: Phases,
        generator: torch.Generator,
        device: torch.device | str,
        *,
        margin: float = 0.0,
        sample: float = 0.05,
    ) -> None:
        self.schedule = schedule
        self.generator = generator
        self.margin = margin
        self.sample = sample
        self.model = ContextModel(config, generator).to(device)
        self.noise = Noise(generator=generator, device=device)
        self._base = torch.tensor([config.steps], device=device)
        self._grid: PositionGrid | None = None
        self._lookups: dict[str, Lookup] = {}

    @property
    def grid(self) -> PositionGrid:
        """The grid of the positions of all anchors.

        Raises:
            RuntimeError: :meth:`place` has not run yet.
        """
        if self._grid is None:
            raise RuntimeError("the anchors were not placed")
        return self._grid

    def groups(self) -> dict[str, Sequence[Tensor]]:
        """Parameters of the second stage for the optimiser."""
        groups: dict[str, Sequence[Tensor]] = {"grid": [self.model.grid.table], "head": self.model.head}
        if self.model.intra is not None:
            groups["intra"] = list(self.model.intra.parameters())
        return groups

    @torch.no_grad()
    def begin(self, values: Sequence[Attributes]) -> None:
        """Start the second stage from these attributes of every scene."""
        self.model.calibrate(*values)

    def place(self, scenes: Sequence[AnchorSet]) -> None:
        """Place changed anchors on one grid for all scenes, so that equal positions have equal contexts."""
        self._lookups.clear()
        positions = np.concatenate([anchors.positions.cpu().numpy() for anchors in scenes])
        if self.margin and len(positions):
            if self._grid is not None and self._grid.holds(positions):
                return
            low, high = positions.min(0), positions.max(0)
            room = self.margin * (high - low)
            positions = np.stack([low - room, high + room])
        self._grid = PositionGrid.lattice(scenes[0].voxel, positions)

    def apply(
        self,
        anchors: AnchorSet,
        values: Attributes,
        rows: Tensor,
        total: int,
        iteration: int,
        masks: Callable[[Tensor], Tensor] | None = None,
        *,
        sample: Tensor | None = None,
        weights: Callable[[Tensor], Tensor] | None = None,
    ) -> tuple[Attributes, MeanBits | None]:
        """Attributes for the decoders in training, and their bits in the phases that count them.

        Args:
            anchors: anchors of the scene.
            values: attributes of its visible anchors.
            rows: indices of the visible anchors.
            total: number of anchors of all scenes.
            iteration: iteration; selects no noise, noise of the base steps, or the context model.
            masks: indices (S,) of visible anchors -> (S, K) of 0 and 1; offsets with mask 0 cost nothing.
            sample: (S,) those of the rows whose bits count; default: a random share of them.
            weights: indices (S,) of visible anchors -> (S,) weights of all bits of an anchor; default 1.
        """
        if not self.schedule.noisy(iteration):
            return values, None
        if not self.schedule.coded(iteration):
            return _sizes(self.model.perturb(values, self._plain(len(rows)), self.noise).values), None
        exact = self.model.coder_exact = self.schedule.exact(iteration)
        if sample is None:
            sample = draw_sample(len(rows), self.generator, self.sample)
        context = self.model(self.lookup(anchors), rows, sample)
        if exact:
            rounded = self.model.round(values, context.steps)
            noisy = Noisy(rounded, rounded.of(context.sample).flat)
        else:
            noisy = self.model.perturb(values, context, self.noise)
        share = None if masks is None else _shares(values, masks(context.sample))
        if weights is not None:
            each = weights(context.sample)[:, None]
            share = each.expand(-1, self.model.config.total) if share is None else share * each
        return _sizes(noisy.values), self.model.mean_bits(noisy, context, anchors=total, share=share)

    def _plain(self, count: int) -> Context:
        """Context of the base steps, without a sample."""
        base = self._base
        none = torch.empty(0, dtype=torch.int64, device=base.device)
        return Context(base.expand(count, -1), base.new_zeros(()), none, base[:0], base[:0])

    def lookup(self, anchors: AnchorSet) -> Lookup:
        """Vertices and weights of the scene's anchors in the hash grid, cached."""
        if anchors.key not in self._lookups:
            codes = torch.from_numpy(self.grid.codes(anchors.positions.cpu().numpy()))
            self._lookups[anchors.key] = self.model.lookup(codes, self.grid.extent)
        return self._lookups[anchors.key]

    def state(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint beside the optimiser's state."""
        saved = {"coding/noise": self.noise.pool, "coding/unit": self.model.unit.clone()}
        if self._grid is not None:
            numbers = (*self._grid.origin, *self._grid.cell, *self._grid.extent)
            saved["coding/grid"] = torch.tensor(numbers, dtype=torch.float64)
        return saved

    @torch.no_grad()
    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        self.noise.pool.copy_(saved["coding/noise"])
        self.model.unit.copy_(saved["coding/unit"])
        if "coding/grid" in saved:
            self._grid = saved_grid(saved)


def saved_grid(saved: Mapping[str, Tensor]) -> PositionGrid:
    """The grid of positions of :meth:`Coding.state`."""
    x, y, z, a, b, c, *extent = saved["coding/grid"].tolist()
    return PositionGrid((x, y, z), (a, b, c), (int(extent[0]), int(extent[1]), int(extent[2])))


def _sizes(values: Attributes) -> Attributes:
    """Attributes with scalings of at least 0: noise may push a small one below, rounding never does."""
    return values._replace(scalings=values.scalings.clamp_min(0.0))


def _shares(values: Attributes, masks: Tensor) -> Tensor:
    """(S, D) weights of each element's bits."""
    before = masks.new_ones((len(masks), values.features.shape[1] + values.scalings.shape[1]))
    return torch.cat([before, masks.repeat_interleave(3, 1)], 1)
