"""Training the anchors of one scene, resumable bit for bit: all of Scaffold-GS, and what HAC builds on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.anchor_set import AnchorSet
from econgs_bench.econgs.anchors.decode import visible_anchors
from econgs_bench.econgs.anchors.direct import NETWORKS, ColorDecoders, decode_colors
from econgs_bench.econgs.anchors.gaussians import Gaussians, apply_masks
from econgs_bench.econgs.anchors.growing import AnchorRules
from econgs_bench.econgs.codec.model import Attributes
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.points import median_neighbour_distance
from econgs_bench.methods.interface import Model, Refused, SceneInput
from econgs_bench.methods.scaffold_gs.model import ScaffoldModel, StoredScene
from econgs_bench.methods.scaffold_gs.schedule import Schedule
from econgs_bench.methods.scaffold_gs.spec import AnchorOptions, ScaffoldOptions
from econgs_bench.methods.shared.anchors import (
    AnchorGrowth,
    AnchorTrainer,
    DrawnAnchors,
    LearningRate,
    start_cloud,
)
from econgs_bench.methods.shared.pruning import Prunable
from econgs_bench.methods.shared.start import thinned
from econgs_bench.methods.shared.training import (
    TrainingState,
    are_transparent,
    chosen_background,
    to_numpy,
    training_images,
)

_MOST_OPACITY = 1.0 - 1e-6
"""Of what is inverted: float32 has hidden Gaussians of -1, whose inverse is infinite."""
DECODER_LEARNING_RATES: dict[str, LearningRate] = {"opacity": (2e-3, 2e-5), "color": (8e-3, 5e-5)}
COVARIANCE_LR = 4e-3
SCALING_LR = 7e-3
OFFSET_LR: LearningRate = (1e-2, 1e-4)
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


class Trainer(AnchorTrainer):
    """A fit of the anchors of one scene.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Raises:
        Refused: no views, no points to start from, or more than ``max_anchors``.
    """

    options: AnchorOptions
    schedule: Schedule
    decoders: ColorDecoders
    distance = False
    masks = False

    def __init__(
        self, scene: SceneInput, options: AnchorOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__([scene], options, iterations, seed, device)
        self.scene = scene
        self.schedule = self.phases(iterations, options)
        start = np.array(start_cloud(scene, options, seed).points, dtype=np.float32)
        if options.start == "cloud":
            start = start[thinned(start, options.start_spacing, scene.train.cameras, options.start_points)]
        points = torch.from_numpy(start)
        voxel = options.voxel or median_neighbour_distance(points, 0.01 * scene.extent)
        self.anchors = AnchorSet(
            KEY,
            points,
            voxel=voxel,
            features=options.features,
            offsets=options.offsets,
            fallback=0.01 * scene.extent,
            scale=options.start_scale,
            masks=self.masks,
            device=device,
        )
        self.sets = [self.anchors]
        limit = options.max_anchors
        if 0 < limit < len(self.anchors):
            raise Refused(f"{len(self.anchors)} initial anchors are more than max_anchors = {limit}")
        try:
            rules = AnchorRules(
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
            hidden=options.hidden,
            distance=self.distance,
            generator=self.generator,
        ).to(device)
        self.background = chosen_background(options.background, scene)
        self.images = training_images(scene.train.images, device)
        self.transparent = are_transparent(self.images)
        groups = self.groups()
        self.optimiser = Adam(groups, dict.fromkeys(groups, 0.0))
        self.densification = AnchorGrowth(self, rules)
        network = self.decoders.network("opacity")
        if options.start_opacity:
            network.start_at(options.start_opacity, self.mean_opacities())
        else:
            self._show_some()

    @torch.no_grad()
    def mean_opacities(self, scene: int = 0) -> Tensor:
        """(K,) outputs of the opacity network, means over anchors and training views.

        Features start at zero, so that the networks hide the same offsets in all anchors, and what is hidden
        gets no gradient.
        """
        values, positions = self.attributes(self.anchors), self.anchors.positions
        opacities = [
            decode_colors(positions, *values, self.decoders, camera.position).raw_opacities
            for camera in self.scene.train.cameras
        ]
        means = [one.clamp(-_MOST_OPACITY, _MOST_OPACITY).atanh().mean(0) for one in opacities]
        return torch.stack(means).mean(0)

    @torch.no_grad()
    def _show_some(self) -> None:
        """Turn the opacity network's sign where the start shows nothing in any training view.

        Few starts give every offset a negative opacity; what is not shown gets no gradient, and such a fit
        would never begin.
        """
        if self.shows_nothing():
            network = self.decoders.network("opacity")
            network.second_weight.neg_()
            network.second_bias.neg_()

    def shows_nothing(self, scene: int = 0) -> bool:
        """Whether every offset of every anchor is hidden in every training view."""
        values, positions = self.attributes(self.anchors), self.anchors.positions
        return not any(
            len(decode_colors(positions, *values, self.decoders, camera.position).slots)
            for camera in self.scene.train.cameras
        )

    # ------------------------------------------------------------------ what HAC changes

    @staticmethod
    def phases(iterations: int, options: Any) -> Schedule:
        """Phases of a fit."""
        return Schedule(iterations, decay=options.decay)

    def groups(self) -> dict[str, Tensor | Sequence[Tensor]]:
        """Parameters of the optimiser."""
        networks = {name: list(self.decoders.network(name).tensors()) for name in NETWORKS}
        return {**self.anchors.groups(), **networks}

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        share = self.decayed((1.0, self.options.last_lr_share))
        anchors = {
            "features": share * self.options.feature_lr,
            "log_scalings": share * SCALING_LR,
            "offsets": self.decayed(OFFSET_LR) * self.scene.extent,
        }
        rates = {self.anchors.name(name): rate for name, rate in anchors.items()}
        rates |= {name: self.decayed(rate) for name, rate in DECODER_LEARNING_RATES.items()}
        return rates | {"covariance": share * COVARIANCE_LR}

    def visible(self, values: Attributes, camera: Camera) -> Tensor:
        """(N,) anchors that may show in a view."""
        return visible_anchors(camera, self.anchors.positions, values.scalings)

    def present(self) -> Tensor | None:
        """(N, K) bool, which offsets there are; None: all."""
        return None

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
            storage=options.storage,
        )
        return ScaffoldModel([stored], state.device)

    def draw(self) -> DrawnAnchors:
        view = self.next_view()
        camera = self.scene.train.cameras[view]
        background = self.color_of(self.background)
        truth = self.images[view].to(self.device)
        values = self.attributes(self.anchors)
        rows = self.visible(values, camera).nonzero()[:, 0]
        if len(rows) < len(self.anchors):
            values = values.of(rows)
        prepared = self.prepare(values, rows)
        decoded = decode_colors(
            self.anchors.positions.index_select(0, rows), *prepared.values, self.decoders, camera.position
        )
        if prepared.masks is not None:
            decoded = apply_masks(decoded, prepared.masks)
        splats, offset = self.splat(decoded, camera)
        losses = self.view_losses(splats.features, splats.alpha, truth, background, self.transparent)
        if len(decoded.scales):
            losses["scale"] = self.options.scale_weight * decoded.scales.prod(dim=1).mean()
        return DrawnAnchors(
            losses={**losses, **prepared.losses},
            camera=camera,
            offset=offset,
            radii=splats.radii,
            anchors=self.anchors,
            rows=rows,
            decoded=decoded,
            empty=len(self.anchors) > 0 and self.is_empty(decoded, truth, self.transparent),
        )

    def prunable(self) -> Iterable[Prunable]:
        views = self.pruning_views(self.scene, self.images, self.transparent, self._in_view)
        yield Prunable(self.count, [views], partial(self.anchors.keep, self.optimiser))

    def _in_view(self, camera: Camera, kept: Tensor) -> tuple[Gaussians, Tensor]:
        """What :data:`.methods.shared.pruning.GaussiansInView` asks for."""
        values = self.attributes(self.anchors)
        rows = (kept & self.visible(values, camera)).nonzero()[:, 0]
        positions = self.anchors.positions.index_select(0, rows)
        decoded = decode_colors(positions, *values.of(rows), self.decoders, camera.position)
        masks = self.present()
        if masks is not None:
            decoded = apply_masks(decoded, masks.index_select(0, rows))
        return decoded, rows[decoded.slots // self.anchors.offsets]

    def views(self) -> list[int]:
        return self.shuffled(len(self.images))


def color_decoders(state: TrainingState, options: AnchorOptions, *, distance: bool) -> ColorDecoders:
    """The networks of a state."""
    decoders = ColorDecoders(
        options.features,
        options.offsets,
        hidden=options.hidden,
        distance=distance,
        generator=torch.Generator(),
    ).to(state.device)
    for name in NETWORKS:
        state.fill(name, decoders.network(name).tensors())
    return decoders.requires_grad_(False)
