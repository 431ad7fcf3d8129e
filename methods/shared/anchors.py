"""Base class of trainers of anchors: Scaffold-GS, HAC and ECoNGS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import PointCloud, random_cloud
from econgs_bench.econgs.anchors.anchor_set import PARAMETERS, AnchorSet
from econgs_bench.econgs.anchors.coding import Coding
from econgs_bench.econgs.anchors.decoders import Decoders
from econgs_bench.econgs.anchors.direct import ColorDecoders
from econgs_bench.econgs.anchors.gaussians import ViewGaussians, draw
from econgs_bench.econgs.anchors.growing import AnchorRules
from econgs_bench.econgs.context.model import Attributes
from econgs_bench.econgs.splat.rasterise import SplatImages
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.shared.schedule import AnchorSchedule
from econgs_bench.methods.shared.training import TrainingLoop, under

Rate = tuple[float, float]
"""First and last learning rate; the option ``decay`` says how it goes from one to the other."""


class AnchorLoop(TrainingLoop):
    """A fit of anchors; arguments as for its base class.

    Attributes:
        sets: the anchors of each scene.
        decoders: the networks of all scenes.
        rules: thresholds of growth.
        coding: quantisation noise and context model; None where nothing is coded.
    """

    sets: list[AnchorSet]
    decoders: Decoders | ColorDecoders
    schedule: AnchorSchedule
    rules: AnchorRules
    coding: Coding | None = None

    @property
    def count(self) -> int:
        """Number of anchors of all scenes."""
        return sum(map(len, self.sets))

    def stage(self) -> str:
        stage = self.schedule.stage(self.iteration + 1)
        if self.count == 0:
            return f"{stage}, no anchors left"
        return f"{stage}, stopped at {self.rules.limit} anchors" if self.limited else stage

    def decayed(self, rate: Rate) -> float:
        """A learning rate at this iteration."""
        return self.schedule.decayed(self.iteration, *rate)

    def attributes(self, anchors: AnchorSet) -> Attributes:
        """Attributes as they are optimised, scalings activated."""
        features, _, offsets = (self.optimiser[anchors.name(one)] for one in PARAMETERS)
        return Attributes(features, anchors.scalings(self.optimiser), offsets)

    def splat(self, decoded: ViewGaussians, camera: Camera) -> tuple[SplatImages, Tensor | None]:
        """Gaussians drawn, and their screen offsets while growth reads the gradients of these."""
        collects = self.schedule.collects(self.iteration)
        offset = torch.zeros_like(decoded.means[:, :2], requires_grad=True) if collects else None
        return draw([decoded], camera, offset, self.fit_low_pass), offset

    @torch.no_grad()
    def revive(
        self,
        truth: Tensor,
        transparent: bool,
        shows_nothing: Callable[[], bool],
        opacities: Callable[[], Tensor],
    ) -> None:
        """Show half of a scene's Gaussians again where all have vanished, though the view's alpha has not.

        A part of the loss of alpha's rescue (:data:`.econgs.losses.RESCUE`): while features are nearly zero,
        all anchors hide together, and what is hidden gets no gradient.

        Args:
            truth: (H, W, 4) of the view.
            transparent: whether any view of the scene is.
            shows_nothing: whether every Gaussian of the scene is hidden in all training views.
            opacities: (K,) mean outputs of the opacity network.
        """
        wanted = self.options.alpha_weight and transparent and bool((truth[..., 3] > 0).any())
        if wanted and shows_nothing():
            self.decoders.network("opacity").show_half(opacities())
            self.optimiser.restart("opacity")

    def begin_coding(self) -> None:
        """Start the context model in its first iteration."""
        if self.coding is not None and self.iteration == self.schedule.context_start + 1:
            self.place()
            self.coding.begin([self.attributes(anchors) for anchors in self.sets])

    def place(self) -> None:
        """Give changed anchors their contexts, once there is a context model."""
        if self.coding is not None and self.schedule.coded(self.iteration):
            self.coding.place(self.sets)

    def settle_rent(self) -> bool:
        due = super().settle_rent()
        if due:
            self.place()
        return due

    def grow(self) -> None:
        """One growth event."""
        self.check_finite()
        for anchors in self.sets:
            places = self.decoded_offsets(anchors)
            self.limited |= anchors.grow_and_prune(self.optimiser, self.rules, self.generator, places)
        self.place()

    def decoded_offsets(self, anchors: AnchorSet) -> Tensor | None:
        """(N, K, 3) offsets where they are decoded instead of stored."""
        return None

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        for anchors in self.sets:
            state.arrays |= {f"anchors/{name}": values.clone() for name, values in anchors.state().items()}
        if self.coding is not None:
            state.arrays |= self.coding.state()
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        super().resume(checkpoint)
        arrays = self.arrays(checkpoint)
        for anchors in self.sets:
            anchors.load_state(under("anchors/", arrays))
        if self.coding is not None:
            self.coding.load_state(arrays)


def hidden_units(anchors: int, per_unit: int, least: int) -> int:
    """Hidden units of a network that so many first anchors are to pay for; 50, ECoNGS's, at most."""
    return min(max(anchors // per_unit, least), 50)


def start_cloud(scene: SceneInput, options: Any, seed: int) -> PointCloud:
    """The points that anchors start from: the scene's, or random ones.

    Raises:
        Refused: the cloud is empty.
    """
    cloud = scene.cloud
    if options.start == "random":
        cloud = random_cloud(options.random_points, options.random_half_extent, seed)
    if len(cloud) == 0:
        raise Refused(f"the initial cloud of scene {scene.name!r} is empty; set start=random")
    return cloud
