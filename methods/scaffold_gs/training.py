"""Training the anchors of one scene, resumable bit for bit: all of Scaffold-GS, and what HAC builds on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.cloud import random_cloud
from econgs.anchors.anchor_set import AnchorSet
from econgs.anchors.decode import visible_anchors
from econgs.anchors.direct import NETWORKS, ColorDecoders, decode_colors
from econgs.anchors.gaussians import apply_masks, draw
from econgs.anchors.growing import AnchorRules
from econgs.context.model import Attributes
from econgs.losses import photometric_loss
from econgs.optim import Adam
from econgs.points import median_neighbour_distance
from econgs.splat.composite import over
from methods.interface import Checkpoint, Model, Refused, SceneInput
from methods.scaffold_gs.model import ScaffoldModel, StoredScene
from methods.scaffold_gs.schedule import Schedule
from methods.scaffold_gs.spec import ScaffoldOptions
from methods.shared.training import CHECK_EVERY, TrainingLoop, TrainingState, to_numpy, under

Rate = tuple[float, float]
"""First and last learning rate; between them it decays log-linearly."""
DECODER_RATES: dict[str, Rate] = {"opacity": (2e-3, 2e-5), "covariance": (4e-3, 4e-3), "color": (8e-3, 5e-5)}
FEATURE_RATE, SCALING_RATE = 7.5e-3, 7e-3
OFFSET_RATE: Rate = (1e-2, 1e-4)
"""Times the extent."""
KEY = "scene"
"""Key of the anchors' parameters in the optimiser."""


@dataclass(frozen=True)
class Prepared:
    """Attributes of the visible anchors as the decoders see them, and further losses.

    Attributes:
        values: attributes, scalings activated.
        masks: (V, K) of 0 and 1, or None.
        losses: further terms of the loss, with their weights.
    """

    values: Attributes
    masks: Tensor | None = None
    losses: Mapping[str, Tensor] = field(default_factory=dict)


class Trainer(TrainingLoop):
    """State of a fit: anchors, networks, optimiser, order of views, random state.

    Args:
        scene: the scene to train.
        options: resolved options of the spec.
        iterations: the budget.
        seed: seed of the only generator.
        device: "cpu" or "cuda".

    Raises:
        Refused: no views, no points to start from, or more than ``max_anchors``.
    """

    options: ScaffoldOptions
    schedule: Schedule
    distance = False
    quantised = False
    masks = False

    def __init__(
        self,
        scene: SceneInput,
        options: ScaffoldOptions,
        iterations: int,
        seed: int,
        device: str,
    ) -> None:
        super().__init__([scene], iterations, seed, device)
        self.scene, self.options = scene, options
        self.schedule = Schedule(iterations, self.quantised)
        points = torch.from_numpy(_start(scene, options, seed))
        voxel = options.voxel or median_neighbour_distance(points, 0.01 * scene.extent)
        self.anchors = AnchorSet(
            KEY,
            points,
            voxel=voxel,
            features=options.features,
            offsets=options.offsets,
            fallback=0.01 * scene.extent,
            masks=self.masks,
            device=device,
        )
        limit = options.max_anchors
        if 0 < limit < len(self.anchors):
            raise Refused(f"{len(self.anchors)} initial anchors are more than max_anchors = {limit}")
        try:
            self.rules = AnchorRules(
                voxel=voxel,
                init_factor=options.init_factor,
                levels=options.growth_levels,
                gradient=options.growth_gradient,
                offset_visits=self.schedule.visits(40.0),
                anchor_visits=self.schedule.visits(80.0),
                limit=limit,
            )
        except ValueError as error:  # options that are possible one by one
            raise Refused(str(error)) from error
        self.decoders = ColorDecoders(
            options.features,
            options.offsets,
            distance=self.distance,
            generator=self.generator,
        ).to(device)
        self.background = _background(scene, options.background)
        self.images = torch.from_numpy(scene.train.images)
        groups = self.groups()
        self.optimiser = Adam(groups, dict.fromkeys(groups, 0.0))
        self._show_some()

    @torch.no_grad()
    def _show_some(self) -> None:
        """Turn the opacity network's sign where the start shows nothing in any training view.

        Few starts give every offset a negative opacity; what is not shown gets no gradient, and such a fit
        would never begin.
        """
        values, positions = self.attributes(), self.anchors.positions
        for camera in self.scene.train.cameras:
            if len(decode_colors(positions, *values, self.decoders, camera.position).slots):
                return
        network = self.decoders.network("opacity")
        network.second_weight.neg_()
        network.second_bias.neg_()

    @property
    def count(self) -> int:
        """Number of anchors."""
        return len(self.anchors)

    # ------------------------------------------------------------------ what HAC changes

    def groups(self) -> dict[str, Tensor | Sequence[Tensor]]:
        """Parameters of the optimiser."""
        networks = {name: list(self.decoders.network(name).tensors()) for name in NETWORKS}
        return {**self.anchors.groups(), **networks}

    def rates(self) -> dict[str, float]:
        """Learning rates of this iteration."""
        offsets = self.decayed(OFFSET_RATE) * self.scene.extent
        anchors = {"features": FEATURE_RATE, "log_scalings": SCALING_RATE, "offsets": offsets}
        rates = {self.anchors.name(name): rate for name, rate in anchors.items()}
        return rates | {name: self.decayed(rate) for name, rate in DECODER_RATES.items()}

    def visible(self, values: Attributes) -> Tensor:
        """(N,) anchors that may show in the view of :attr:`camera`."""
        return visible_anchors(self.camera, self.anchors.positions, values.scalings)

    def prepare(self, values: Attributes, rows: Tensor) -> Prepared:
        """Prepare attributes for decoding: unchanged here.

        Args:
            values: attributes of the visible anchors.
            rows: (V,) which of all anchors they are.
        """
        return Prepared(values)

    @staticmethod
    def restored(state: TrainingState, options: ScaffoldOptions) -> Model:
        """The anchors of a state, in float32."""
        (label,) = state.scenes
        stored = StoredScene.of(
            label.name,
            label.background,
            color_decoders(state, options, distance=False),
            to_numpy(state.arrays[f"anchors/{KEY}/positions"]),
            *(to_numpy(state.value(f"{KEY}/{name}")) for name in ("features", "log_scalings", "offsets")),
        )
        return ScaffoldModel([stored], state.device)

    # ------------------------------------------------------------------ a step

    def step(self) -> dict[str, float]:
        """One step of the optimiser on one view, and what the schedule adds to it.

        Returns:
            The loss ("loss") and its parts.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        self.iteration += 1
        view = self.next_view()
        camera = self.camera = self.scene.train.cameras[view]
        background = self._background_now()
        truth = self.images[view].to(self.device)
        target = over(truth[..., :3], truth[..., 3], background)
        values = self.attributes()
        rows = self.visible(values).nonzero()[:, 0]
        if len(rows) < len(self.anchors):
            values = values.of(rows)
        prepared = self.prepare(values, rows)
        decoded = decode_colors(
            self.anchors.positions.index_select(0, rows), *prepared.values, self.decoders, camera.position
        )
        if prepared.masks is not None:
            decoded = apply_masks(decoded, prepared.masks)
        collects = self.schedule.collects(self.iteration)
        offset = torch.zeros_like(decoded.means[:, :2], requires_grad=True) if collects else None
        splats = draw([decoded], camera, offset)
        image = over(splats.features, splats.alpha, background)
        losses = {"image": photometric_loss(image, target, self.options.ssim_weight)}
        if len(decoded.scales):
            losses["scale"] = self.options.scale_weight * decoded.scales.prod(dim=1).mean()
        losses |= prepared.losses
        numbers = self.numbers(losses)
        loss = torch.stack(list(losses.values())).sum()
        if loss.requires_grad:
            self.optimiser.zero_grad()
            loss.backward()
            if offset is not None and offset.grad is not None:
                self.anchors.statistics.record(
                    rows,
                    decoded.raw_opacities,
                    decoded.slots,
                    offset.grad,
                    splats.radii,
                    (camera.width, camera.height),
                )
            self.optimiser.rates.update(self.rates())
            self.optimiser.step()
        if self.schedule.grows(self.iteration):
            self.grow()
        if self.iteration % CHECK_EVERY == 0:
            self.check_finite()
        return {"loss": sum(numbers.values()), **numbers}

    def attributes(self) -> Attributes:
        """Attributes of all anchors as they are optimised, scalings activated."""
        names = ("features", "log_scalings", "offsets")
        features, log_scalings, offsets = (self.optimiser[self.anchors.name(name)] for name in names)
        return Attributes(features, log_scalings.exp(), offsets)

    def decayed(self, rate: Rate) -> float:
        """A learning rate at this iteration."""
        return self.schedule.decayed(self.iteration, *rate)

    def grow(self) -> None:
        """One growth event."""
        self.check_finite()
        self.limited |= self.anchors.grow_and_prune(self.optimiser, self.rules, self.generator).limited

    def stage(self) -> str:
        stage = self.schedule.stage(self.iteration + 1)
        if len(self.anchors) == 0:
            return f"{stage}, no anchors left"
        return f"{stage}, stopped at {self.rules.limit} anchors" if self.limited else stage

    def views(self) -> list[int]:
        return self.shuffled(len(self.images))

    def _background_now(self) -> tuple[float, float, float]:
        if self.background is not None:
            return self.background
        red, green, blue = torch.rand(3, generator=self.generator).tolist()
        return red, green, blue

    # ------------------------------------------------------------------ checkpoints

    def checkpoint(self) -> Checkpoint:
        """All that :meth:`resume` needs to go on as if nothing had happened."""
        state = super().checkpoint()
        state.arrays |= {f"anchors/{name}": values.clone() for name, values in self.anchors.state().items()}
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same fit."""
        super().resume(checkpoint)
        self.anchors.load_state(under("anchors/", self.arrays(checkpoint)))


def color_decoders(state: TrainingState, options: ScaffoldOptions, *, distance: bool) -> ColorDecoders:
    """The networks of a state."""
    decoders = ColorDecoders(
        options.features, options.offsets, distance=distance, generator=torch.Generator()
    ).to(state.device)
    for name in NETWORKS:
        state.fill(name, decoders.network(name).tensors())
    return decoders.requires_grad_(False)


def _start(scene: SceneInput, options: ScaffoldOptions, seed: int) -> NDArray[np.float32]:
    cloud = scene.cloud
    if options.start == "random":
        cloud = random_cloud(options.random_points, options.random_half_extent, seed)
    if len(cloud) == 0:
        raise Refused(f"the initial cloud of scene {scene.name!r} is empty; set start=random")
    return np.array(cloud.points, dtype=np.float32)


def _background(scene: SceneInput, choice: str) -> tuple[float, float, float] | None:
    """Background of training views; None: a random color each time."""
    fixed = {"scene": scene.train.background, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
    return fixed.get(choice)
