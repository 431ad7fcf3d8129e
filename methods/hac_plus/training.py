"""Training HAC++: HAC with mixtures for features, and masks that learn from bits."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from econgs_bench.econgs.anchors.anchor_set import MASKS
from econgs_bench.econgs.codec.model import Attributes, ContextConfig, draw_sample
from econgs_bench.methods.hac import training as hac
from econgs_bench.methods.hac.training import LEAST_MASK
from econgs_bench.methods.hac_plus.model import HacPlusModel
from econgs_bench.methods.hac_plus.spec import HacPlusOptions
from econgs_bench.methods.scaffold_gs.training import Prepared
from econgs_bench.methods.shared.anchors import LearningRate

INTRA_LR: LearningRate = (5e-3, 5e-4)
LAST_MASK_LR, MOST_LAST_MASK_LR = 8e-5, 1.5e-3
"""Last learning rate of masks, as a multiple of the scene's extent: at lambda = 0.001 (it is proportional to
lambda), and at most."""


class Trainer(hac.Trainer):
    """State of a fit; see :class:`.methods.scaffold_gs.training.Trainer`."""

    options: HacPlusOptions
    model_class = HacPlusModel

    @staticmethod
    def context_config(options: Any, hidden: int) -> ContextConfig:
        """Sizes of the context model."""
        return ContextConfig.of(options, options.features, hidden, options.chunk)

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        return super().learning_rates(scene) | {"intra": self.decayed(INTRA_LR)}

    @property
    def last_mask_lr(self) -> float:
        """In proportion to lambda."""
        return max(1e-8, min(MOST_LAST_MASK_LR, LAST_MASK_LR * self.options.rate_weight / 1e-3))

    def prepare(self, values: Attributes, rows: Tensor) -> Prepared:
        """As in HAC, but bits are those of a sample of all anchors, visible or not.

        Each bit is weighted by the mask of its anchor, those of offsets also by their own: masks learn from
        what they would save.
        """
        if not self.schedule.coded(self.iteration):
            return super().prepare(values, rows)
        total, seen = len(self.anchors), len(rows)
        masks, anchors, soft = self._masks()
        sample = draw_sample(total, self.generator, self.coding.sample).to(rows.device)
        every = torch.cat([rows, sample])
        noisy, bits = self.coding.apply(
            self.anchors,
            self.attributes(self.anchors).of(every),
            every,
            total,
            self.iteration,
            partial(masks[every].index_select, 0),
            sample=torch.arange(seen, len(every)),
            weights=partial(anchors[every].index_select, 0),
        )
        losses: dict[str, Tensor] = {}
        if bits is not None and total:
            losses["rate"] = self.options.rate_weight * (bits.attributes + bits.grid)
            if self.options.mask_weight:
                losses["masks"] = self.options.mask_weight * soft.mean()
        shown = Attributes(*(one[:seen] for one in noisy))
        return Prepared(shown, masks.index_select(0, rows), losses)

    def _masks(self) -> tuple[Tensor, Tensor, Tensor]:
        """(N, K) masks and (N,) those of anchors, 0 or 1 with straight-through gradients; (N, K) sigmoids.

        An anchor is there if one of its offsets is; its gradient is that of the mean of its masks.
        """
        soft = self.optimiser[self.anchors.name(MASKS)].sigmoid()
        masks = (soft.detach() > LEAST_MASK).to(soft.dtype) + (soft - soft.detach())
        mean = masks.mean(1)
        anchors = (mean.detach() > 0.0).to(soft.dtype) + (mean - mean.detach())
        return masks, anchors, soft
