"""Base class of trainers of anchors: Scaffold-GS, HAC and ECoNGS."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

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
from econgs_bench.econgs.codec.model import Attributes
from econgs_bench.econgs.splat.rasterise import SplatImages
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.shared.densification import Densification, DrawnView
from econgs_bench.methods.shared.schedule import AnchorSchedule
from econgs_bench.methods.shared.splat_training import SplatTrainer
from econgs_bench.methods.shared.training import under

LearningRate = tuple[float, float]
"""First and last learning rate; the option ``decay`` says how it goes from one to the other."""


class CloudOptions(Protocol):
    """Options of the points that anchors start from."""

    @property
    def start(self) -> str:
        """Whether anchors start from the scene's cloud, or at "random"."""

    @property
    def random_points(self) -> int:
        """Number of points of a random start."""

    @property
    def random_half_extent(self) -> float:
        """Half side of the cube of a random start, scene units."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnAnchors(DrawnView):
    """A view of anchors.

    Attributes:
        anchors: anchors of the drawn scene.
        rows: (V,) numbers of the visible anchors.
        decoded: their Gaussians.
        empty: the view shows none of them, though something is to be seen.
    """

    anchors: AnchorSet
    rows: Tensor
    decoded: ViewGaussians
    empty: bool


class AnchorGrowth(Densification["AnchorTrainer", DrawnAnchors]):
    """Grows anchors where the gradients of their Gaussians are high, prunes faint ones, rescues hidden ones.

    Args:
        fit: the fit.
        rules: thresholds of growing and pruning.
    """

    def __init__(self, fit: AnchorTrainer, rules: AnchorRules) -> None:
        super().__init__(fit)
        self.rules = rules

    def after_backward(self, drawn: DrawnAnchors) -> None:
        if drawn.offset is None or drawn.offset.grad is None:
            return
        drawn.anchors.statistics.record(
            drawn.rows,
            drawn.decoded.raw_opacities,
            drawn.decoded.slots,
            drawn.offset.grad * self.fit.batch,
            drawn.radii,
            (drawn.camera.width, drawn.camera.height),
        )

    def after_step(self, drawn: DrawnAnchors) -> None:
        if drawn.empty:
            self.rescue(drawn.scene)
        if self.fit.schedule.grows(self.fit.iteration):
            self.grow()

    def rescue(self, scene: int) -> None:
        """Show half of a scene's Gaussians again where all of them are hidden in every training view.

        A part of the loss of alpha's rescue (:data:`.econgs.losses.RESCUE`): while features are nearly zero,
        all anchors hide together, and what is hidden gets no gradient.
        """
        if self.fit.shows_nothing(scene):
            self.fit.decoders.network("opacity").show_half(self.fit.mean_opacities(scene))
            self.fit.optimiser.restart("opacity")

    def grow(self) -> None:
        """One growth event."""
        fit = self.fit
        fit.check_finite()
        for anchors in fit.sets:
            places = fit.decoded_offsets(anchors)
            self.limited |= anchors.grow_and_prune(fit.optimiser, self.rules, fit.generator, places)
        fit.place()

    def stage(self) -> str:
        stage = self.fit.schedule.stage(self.fit.iteration + 1)
        if self.fit.count == 0:
            return f"{stage}, no anchors left"
        return f"{stage}, stopped at {self.rules.limit} anchors" if self.limited else stage


class AnchorTrainer(SplatTrainer[DrawnAnchors]):
    """A fit of anchors; arguments as for its base class.

    Attributes:
        sets: the anchors of each scene.
        decoders: the networks of all scenes.
        coding: quantisation noise and context model; None where nothing is coded.
    """

    sets: list[AnchorSet]
    decoders: Decoders | ColorDecoders
    schedule: AnchorSchedule
    coding: Coding | None = None

    @property
    def count(self) -> int:
        """Number of anchors of all scenes."""
        return sum(map(len, self.sets))

    @abstractmethod
    def shows_nothing(self, scene: int) -> bool:
        """Whether every Gaussian of a scene is hidden in every training view."""

    @abstractmethod
    def mean_opacities(self, scene: int) -> Tensor:
        """(K,) outputs of the opacity network, means over the anchors and training views of a scene."""

    def decayed(self, rate: LearningRate) -> float:
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

    def is_empty(self, decoded: ViewGaussians, truth: Tensor, transparent: bool) -> bool:
        """Whether a view shows no Gaussian, though alpha is a target and not zero everywhere.

        Args:
            decoded: Gaussians of the view.
            truth: (H, W, 4) of the view.
            transparent: whether any view of the scene is.
        """
        return not len(decoded.slots) and self.asks_alpha(transparent) and bool((truth[..., 3] > 0).any())

    def begin_coding(self) -> None:
        """Start the context model in its first iteration."""
        if self.coding is not None and self.iteration == self.schedule.context_start + 1:
            self.place()
            self.coding.begin([self.attributes(anchors) for anchors in self.sets])

    def place(self) -> None:
        """Give changed anchors their contexts, once there is a context model."""
        if self.coding is not None and self.schedule.coded(self.iteration):
            self.coding.place(self.sets)

    def begin_step(self) -> None:
        if self.prune():
            self.place()
        self.begin_coding()

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


def start_cloud(scene: SceneInput, options: CloudOptions, seed: int) -> PointCloud:
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
