"""Training HAC: Scaffold-GS under quantisation noise, with offset masks and bits in the loss."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.anchor_set import MASKS
from econgs_bench.econgs.anchors.coding import Coding, saved_grid
from econgs_bench.econgs.codec.arrays import round_arrays
from econgs_bench.econgs.codec.group import GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.model import Attributes, ContextConfig, draw_sample
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.codec.quantiser import round_group
from econgs_bench.methods.hac.model import HacModel
from econgs_bench.methods.hac.spec import HacOptions
from econgs_bench.methods.interface import Checkpoint
from econgs_bench.methods.scaffold_gs import training as scaffold_gs
from econgs_bench.methods.scaffold_gs.schedule import Schedule
from econgs_bench.methods.scaffold_gs.training import KEY, Prepared, color_decoders
from econgs_bench.methods.shared.anchors import LearningRate, hidden_units
from econgs_bench.methods.shared.coding import coded_context
from econgs_bench.methods.shared.training import TrainingState, to_numpy

LEAST_MASK = 0.01
"""An offset is there if the sigmoid of its mask exceeds this."""
BOX_MARGIN = 0.1
"""The box of the context's positions exceeds the anchors by this share on every side (published: 1.2 x)."""
MASK_LR: LearningRate = (1e-2, 1e-4)
"""As published, times the extent."""
CONTEXT_LR: LearningRate = (5e-3, 1e-5)


class Trainer(scaffold_gs.Trainer):
    """State of a fit; see :class:`.methods.scaffold_gs.training.Trainer`."""

    options: HacOptions
    coding: Coding
    distance = True
    masks = True
    model_class: ClassVar[type[HacModel]] = HacModel

    @staticmethod
    def phases(iterations: int, options: Any) -> Schedule:
        return Schedule(iterations, coding=True, context_share=options.context_start, decay=options.decay)

    def groups(self) -> dict[str, Tensor | Sequence[Tensor]]:
        """Parameters of the optimiser; the context model is made here, after the decoders."""
        hidden = self.options.context_hidden or hidden_units(len(self.anchors), 100, 4)
        config = self.context_config(self.options, hidden)
        self.coding = Coding(config, self.schedule, self.generator, self.device, margin=BOX_MARGIN)
        return {**super().groups(), **self.coding.groups()}

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        context = self.decayed(CONTEXT_LR)
        masks = self.options.mask_lr / MASK_LR[0] * self.decayed((MASK_LR[0], self.last_mask_lr))
        masks *= self.scene.extent
        own = {self.anchors.name(MASKS): masks, "grid": context, "head": context}
        return super().learning_rates(scene) | own

    @property
    def last_mask_lr(self) -> float:
        """Last learning rate of masks where the first one is the published; times the extent."""
        return MASK_LR[1]

    def visible(self, values: Attributes, camera: Camera) -> Tensor:
        """(N,) anchors that may show in a view; while growth counts visits, those without an offset too.

        They count as visited with opacity 0, so that pruning takes them.
        """
        visible = super().visible(values, camera)
        return visible if self.schedule.collects(self.iteration) else visible & self.present().any(1)

    def present(self) -> Tensor:
        """(N, K) which offsets there are."""
        return self.optimiser[self.anchors.name(MASKS)].detach().sigmoid() > LEAST_MASK

    def prepare(self, values: Attributes, rows: Tensor) -> Prepared:
        """Noise or rounding, masks with straight-through gradients, and the losses of bits and masks."""
        soft = self.optimiser[self.anchors.name(MASKS)].sigmoid()
        hard = (soft.detach() > LEAST_MASK).to(soft.dtype)
        masks = (hard + (soft - soft.detach())).index_select(0, rows)
        masks_of = partial(masks.index_select, 0)
        total = len(self.anchors)
        sample = None
        if self.schedule.coded(self.iteration):  # bits are those of anchors that are there
            there = hard.index_select(0, rows).any(1).nonzero()[:, 0]
            chosen = draw_sample(len(there), self.generator, self.coding.sample)
            sample = there.index_select(0, chosen.to(there.device))
        values, bits = self.coding.apply(
            self.anchors, values, rows, total, self.iteration, masks_of, sample=sample
        )
        losses: dict[str, Tensor] = {}
        if bits is not None and total:
            valid = float(hard.any(1).float().mean())
            losses["rate"] = self.options.rate_weight * (bits.attributes * valid + bits.grid)
            losses["masks"] = self.options.mask_weight * soft.mean()
        return Prepared(values, masks, losses)

    @staticmethod
    def context_config(options: Any, hidden: int) -> ContextConfig:
        """Sizes of the context model."""
        return ContextConfig.of(options, options.features, hidden)

    @classmethod
    @torch.no_grad()
    def restored(cls, state: TrainingState, options: HacOptions) -> HacModel:  # type: ignore[override]
        """As the state's stream would give it back: rounded once the context model is on."""
        (label,) = state.scenes
        masks = (state.value(f"{KEY}/{MASKS}").sigmoid() > LEAST_MASK).cpu().numpy()
        keep = masks.any(1)
        positions = to_numpy(state.arrays[f"anchors/{KEY}/positions"])[keep]
        raw = {name: state.value(f"{KEY}/{name}") for name in ("features", "log_scalings", "offsets")}
        values = raw["features"], raw["log_scalings"].exp(), raw["offsets"]
        features, scalings, offsets = (to_numpy(one)[keep] for one in values)
        coded = cls.phases(state.iterations, options).coded(state.iteration)
        config = cls.context_config(options, len(state.value("head")))  # rows of its first layer
        decoders, precision = color_decoders(state, options, distance=True), options.decoder_precision
        group = GroupAttributes(
            (SceneAttributes(label.name, positions, features, scalings, offsets, masks=masks[keep]),),
            saved_grid(state.arrays) if coded else PositionGrid.lattice(state.scalars["voxel"], positions),
            coded_context(state, config) if coded else None,
            round_arrays({name: to_numpy(one) for name, one in decoders.state_dict().items()}, precision),
            cls.model_class.metadata(label.background, precision),
        )
        return cls.model_class([round_group(group)], state.device)

    def checkpoint(self) -> Checkpoint:
        checkpoint = super().checkpoint()
        checkpoint.scalars["voxel"] = self.anchors.voxel
        return checkpoint
