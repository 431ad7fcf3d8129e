"""Training a group of scenes together: ECoNGS's two stages, resumable bit for bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.anchor_set import AnchorSet
from econgs_bench.econgs.anchors.coding import Coding
from econgs_bench.econgs.anchors.colors import offset_colors
from econgs_bench.econgs.anchors.decode import decode, visible_anchors
from econgs_bench.econgs.anchors.decoders import Decoders
from econgs_bench.econgs.anchors.folding import fold_embeddings
from econgs_bench.econgs.anchors.gaussians import ViewGaussians
from econgs_bench.econgs.anchors.growing import AnchorRules
from econgs_bench.econgs.anchors.scalings import activated
from econgs_bench.econgs.anchors.shading import raw_specular
from econgs_bench.econgs.codec.arrays import round_arrays
from econgs_bench.econgs.codec.group import GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.model import Attributes, ContextConfig
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.codec.quantiser import round_group
from econgs_bench.econgs.optim import Adam
from econgs_bench.methods.econgs.control import STEPS, RateControl
from econgs_bench.methods.econgs.model import EcongsModel, Group, decoders_metadata
from econgs_bench.methods.econgs.schedule import Schedule
from econgs_bench.methods.econgs.spec import EcongsOptions
from econgs_bench.methods.econgs.start import starting_points
from econgs_bench.methods.interface import Checkpoint, SceneInput
from econgs_bench.methods.shared.anchors import (
    AnchorGrowth,
    AnchorTrainer,
    DrawnAnchors,
    LearningRate,
    hidden_units,
)
from econgs_bench.methods.shared.coding import coded_context
from econgs_bench.methods.shared.pruning import GaussiansInView, Prunable, some_views
from econgs_bench.methods.shared.training import (
    TrainingState,
    are_transparent,
    to_numpy,
    training_images,
)

DECODER_LEARNING_RATES: dict[str, LearningRate] = {
    "opacity": (2e-3, 2e-5),
    "shading": (8e-3, 5e-5),
    "normal": (8e-3, 5e-5),
    "offset": (2e-3, 2e-5),
}
COVARIANCE_LR = 4e-3
"""Its first learning rate; the last is a share of it, the option ``last_lr_share``."""
STATED_LEARNING_RATES: dict[str, LearningRate] = {"opacity": (1e-2, 1e-4), "covariance": (1e-2, 1e-4)}
"""Of the networks that decode what the paper's sentence on learning rates names."""
SCALING_LR: LearningRate = (1e-2, 1e-4)
OFFSET_LR: LearningRate = (1e-2, 1e-4)
"""Times the extent."""
CONTEXT_LR: LearningRate = (5e-3, 1e-5)
EMBEDDING_LR: LearningRate = (2e-3, 2e-5)
_EMBEDDING_SPREAD = 0.01
COLOR_SAMPLE = 256
"""Anchors whose offset colors a step regularises."""
BEYOND = 10.0
"""Weight of diffuse colors outside [0, 1] against that of offset colors."""


class _Scene:
    """One scene of the group: its views and its anchors."""

    def __init__(
        self,
        key: str,
        source: SceneInput,
        start: tuple[NDArray[np.float32], NDArray[np.float32]],
        options: EcongsOptions,
        decoders: Decoders,
        generator: torch.Generator,
        device: str,
    ) -> None:
        points, color = start
        self.key, self.source, self.name = key, source, source.name
        self.anchors = AnchorSet(
            key,
            torch.from_numpy(points),
            voxel=options.voxel,
            features=decoders.width,
            offsets=decoders.offsets,
            fallback=0.01 * source.extent,
            scale=options.start_scale,
            activation=options.scaling_activation,
            device=device,
        )
        stored = decoders.initial_explicit(len(self.anchors), generator)
        self.anchors.initial["features"][:, decoders.features :] = stored.to(device)
        self.palette = torch.from_numpy(color)
        self.images = training_images(source.train.images, device)
        self.transparent = are_transparent(self.images)
        light = source.scene.light
        self.light = None if light is None else light.direction


class Trainer(AnchorTrainer):
    """A fit of anchors of every scene and networks that they share. Each iteration draws a view of one scene.

    Arguments: the scenes to train together, resolved options, and those of
    :class:`.methods.shared.training.TrainingLoop`.

    Raises:
        Refused: a scene without views or points.
    """

    options: EcongsOptions
    schedule: Schedule
    decoders: Decoders

    def __init__(
        self, group: Sequence[SceneInput], options: EcongsOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__(group, options, iterations, seed, device)
        self.schedule = make_schedule(iterations, options)
        starts = [starting_points(source, options, seed) for source in group]
        first = sum(len(points) for points, _ in starts)
        hidden = options.hidden or hidden_units(first, 50, 25)
        self.decoders = make_decoders(options, hidden, self.generator).to(device)
        shared = (options, self.decoders, self.generator, device)
        self.scenes = [
            _Scene(str(i), source, start, *shared)
            for i, (source, start) in enumerate(zip(group, starts, strict=True))
        ]
        self.sets = [scene.anchors for scene in self.scenes]
        rules = AnchorRules(
            voxel=options.voxel,
            init_factor=options.init_factor,
            gradient=growth_threshold(group, options, iterations),
            offset_visits=self.schedule.visits(40.0),
            anchor_visits=self.schedule.visits(80.0),
            limit=options.max_anchors,
        )
        self.batch = len(self.scenes) if options.minibatch == "scenes" else 1
        groups: dict[str, Tensor | Sequence[Tensor]] = {}
        for scene in self.scenes:
            groups |= scene.anchors.groups()
            embedding = torch.randn(options.embedding, generator=self.generator)
            groups[f"{scene.key}/palette"] = scene.palette.to(device)
            groups[f"{scene.key}/embedding"] = (_EMBEDDING_SPREAD * embedding).to(device)
        groups |= {name: list(self.decoders.network(name).tensors()) for name in self.decoders.names}
        self.context_hidden = options.context_hidden or hidden_units(first, 100, 4)
        if self.schedule.coding:
            config = ContextConfig.of(options, self.decoders.width, self.context_hidden)
            self.coding = Coding(config, self.schedule, self.generator, device, sample=options.rate_sample)
            groups |= self.coding.groups()
        self.optimiser = Adam(groups, dict.fromkeys(groups, 0.0))
        self.densification = AnchorGrowth(self, rules)
        self.control = RateControl(options.target_bytes * len(self.scenes), options.target_psnr)

    def draw(self) -> DrawnAnchors:
        place, view = self.next_view()
        scene = self.scenes[place]
        camera = scene.source.train.cameras[view]
        truth = scene.images[view].to(self.device)
        anchors, values = scene.anchors, self.attributes(scene.anchors)
        rows = visible_anchors(camera, anchors.positions, values.scalings).nonzero()[:, 0]
        positions = anchors.positions
        if len(rows) < len(positions):
            positions = positions.index_select(0, rows)
            values = values.of(rows)
        bits = None
        if self.coding is not None:
            masks = self._masks(scene, values) if culls(self.options) else None
            values, bits = self.coding.apply(anchors, values, rows, self.count, self.iteration, masks)
        decoded = self._decode(scene, camera, positions, values)
        splats, offset = self.splat(decoded, camera)
        back = scene.source.train.background
        parts = self.view_losses(splats.features, splats.alpha, truth, back, scene.transparent)
        parts["scale"] = self._scale_loss(decoded.scales)
        if self.options.color_weight:
            parts["color"] = self._color_loss(scene, camera, positions, values.features)
        if bits is not None:
            present_lambda = self.options.rate_weight * self.control.factor
            parts["rate"] = present_lambda * (bits.attributes + bits.grid)
        return DrawnAnchors(
            losses=parts,
            figures={} if bits is None else {"bits per attribute": bits.attributes},
            scene=place,
            camera=camera,
            offset=offset,
            radii=splats.radii,
            anchors=anchors,
            rows=rows,
            decoded=decoded,
            empty=len(anchors) > 0 and self.is_empty(decoded, truth, scene.transparent),
        )

    def step(self) -> dict[str, float]:
        report = super().step()
        if self.control.active and self.schedule.corrects_rate(self.iteration, STEPS):
            model = self.model()
            self.control.correct(model.bytes_estimate(), self._psnr(model))
        return report

    def completes_batch(self) -> bool:
        """Whether the optimiser steps now: when each scene had its view, or anchors are about to change."""
        schedule, i = self.schedule, self.iteration
        changes = schedule.grows(i) or schedule.prunes_by_contribution(i + 1) or i == schedule.context_start
        return i % self.batch == 0 or changes or i == schedule.iterations

    def _decode(self, scene: _Scene, camera: Camera, positions: Tensor, values: Attributes) -> ViewGaussians:
        """Gaussians of these anchors of a scene."""
        return decode(
            positions,
            *values,
            self.decoders,
            self.optimiser[f"{scene.key}/embedding"],
            self.optimiser[f"{scene.key}/palette"],
            camera.position,
            light=scene.light,
        )

    @torch.no_grad()
    def _opacities(self, scene: int) -> Tensor:
        """(N, K) outputs of the opacity network, the same in every view."""
        one = self.scenes[scene]
        names = one.anchors.name("features"), f"{one.key}/embedding"
        return self.decoders.raw_opacities(*(self.optimiser[name] for name in names))

    def shows_nothing(self, scene: int) -> bool:
        """Whether every Gaussian of a scene is hidden, from every direction."""
        return not self.options.view_direction and bool((self._opacities(scene) <= 0.0).all())

    def mean_opacities(self, scene: int) -> Tensor:
        return self._opacities(scene).mean(0)

    def _masks(self, scene: _Scene, values: Attributes) -> Callable[[Tensor], Tensor]:
        """The Gaussians of some of these anchors that are not culled: only they need offsets."""
        embedding = self.optimiser[f"{scene.key}/embedding"]
        return lambda rows: self.decoders.shown(values.features.index_select(0, rows), embedding)

    def _scale_loss(self, scales: Tensor) -> Tensor:
        """The regulariser of the product of scales, over the Gaussians drawn."""
        products = scales.prod(dim=1)
        if not len(products):
            return scales.new_zeros(())
        total = products.mean() if self.options.scale_loss == "mean" else products.sum()
        return self.options.scale_weight * total

    def _color_loss(self, scene: _Scene, camera: Camera, positions: Tensor, features: Tensor) -> Tensor:
        """The regulariser of offset colors, over a sample of the anchors in view.

        What cancels in the pictures need not cancel after an edit: a highlight too strong for the light, with
        an offset that takes its color away again, is right only for the palette color it was learned with.
        """
        if not len(positions):
            return positions.new_zeros(())
        if len(positions) > COLOR_SAMPLE:
            sample = torch.randint(len(positions), (COLOR_SAMPLE,), generator=self.generator).to(self.device)
            positions, features = positions.index_select(0, sample), features.index_select(0, sample)
        eye = torch.as_tensor(camera.position, dtype=positions.dtype, device=self.device)
        embedding, palette = (self.optimiser[f"{scene.key}/{what}"] for what in ("embedding", "palette"))
        offsets = offset_colors(self.decoders, positions, features, embedding, eye)
        base = palette.detach()[:, None] + offsets
        beyond = (base - base.clamp(0.0, 1.0)).square().mean()
        return self.options.color_weight * (offsets.square().mean() + BEYOND * beyond)

    def views(self) -> list[tuple[int, int]]:
        """Pairs of scene and view; with a minibatch of every scene, scenes take turns."""
        counts = [len(scene.images) for scene in self.scenes]
        if self.batch > 1:
            orders = [self.shuffled(count) for count in counts]
            return [
                (i, order[turn % len(order)]) for turn in range(max(counts)) for i, order in enumerate(orders)
            ]
        pairs = [(i, view) for i, count in enumerate(counts) for view in range(count)]
        return [pairs[i] for i in self.shuffled(len(pairs))]

    def prunable(self) -> Iterable[Prunable]:
        for scene in self.scenes:
            views = self.pruning_views(
                scene.source, scene.images, scene.transparent, self._gaussians_in_view(scene)
            )
            yield Prunable(len(scene.anchors), [views], partial(scene.anchors.keep, self.optimiser))

    def _gaussians_in_view(self, scene: _Scene) -> GaussiansInView:
        """Decodes the anchors of a scene as they are now."""
        positions, values = scene.anchors.positions, self.attributes(scene.anchors)

        def in_view(camera: Camera, kept: Tensor) -> tuple[ViewGaussians, Tensor]:
            rows = (kept & visible_anchors(camera, positions, values.scalings)).nonzero()[:, 0]
            decoded = self._decode(scene, camera, positions.index_select(0, rows), values.of(rows))
            return decoded, rows[decoded.slots // scene.anchors.offsets]

        return in_view

    def _psnr(self, model: EcongsModel) -> float:
        """Mean of the scenes' PSNR on validation views, or on some training views where there are none."""
        values = []
        for scene in self.scenes:
            views = scene.source.validation if len(scene.source.validation) else scene.source.train
            sample = some_views(len(views), 8)
            error = 0.0
            for view in sample:
                rgb, _ = model.render(views.cameras[view], [scene.name], background=views.background)
                truth = torch.from_numpy(views.composited(view)).to(rgb.device)
                error += float((rgb - truth).square().mean()) / len(sample)
            values.append(-10.0 * math.log10(max(error, 1e-10)))
        return sum(values) / len(values)

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        drawn, first = self.scenes[scene], self.options.feature_lr
        decoders = {
            **DECODER_LEARNING_RATES,
            "covariance": (COVARIANCE_LR, self.options.last_lr_share * COVARIANCE_LR),
        }
        if self.options.decoder_rates == "stated":
            decoders |= STATED_LEARNING_RATES
        rates = {name: self.decayed(decoders[name]) for name in self.decoders.names}
        rates[drawn.anchors.name("features")] = self.decayed((first, 0.01 * first))
        rates[drawn.anchors.name("log_scalings")] = self.decayed(SCALING_LR)
        rates[drawn.anchors.name("offsets")] = self.decayed(OFFSET_LR) * drawn.source.extent
        rates[f"{drawn.key}/embedding"] = self.decayed(EMBEDDING_LR)
        rates[f"{drawn.key}/palette"] = self.options.palette_lr
        if self.coding is not None:
            rates["grid"] = rates["head"] = self.decayed(CONTEXT_LR)
        return rates

    @torch.no_grad()
    def decoded_offsets(self, anchors: AnchorSet) -> Tensor | None:
        if self.decoders.storage != "implicit":
            return None
        features, embedding = (self.optimiser[anchors.name(name)] for name in ("features", "embedding"))
        return self.decoders.implicit_offsets(features, embedding)

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    @torch.no_grad()
    def restored(state: TrainingState, options: EcongsOptions) -> EcongsModel:
        """As the state's stream would give it back: rounded, in the second stage."""
        keys = [str(place) for place in range(len(state.scenes))]
        places = [to_numpy(state.arrays[f"anchors/{key}/positions"]) for key in keys]
        hidden, context_hidden = state.scalars["hidden"]
        decoders = make_decoders(options, hidden, torch.Generator()).to(state.device)
        for name in decoders.names:
            state.fill(name, decoders.network(name).tensors())
        embeddings = [state.value(f"{key}/embedding") for key in keys]
        if options.fold_embeddings:
            decoders, embeddings = fold_embeddings(decoders, embeddings)
        scenes = tuple(
            SceneAttributes(
                label.name,
                positions,
                features=to_numpy(state.value(f"{key}/features")),
                scalings=to_numpy(activated(state.value(f"{key}/log_scalings"), options.scaling_activation)),
                offsets=to_numpy(state.value(f"{key}/offsets")),
                parameters={
                    "palette": to_numpy(state.value(f"{key}/palette")),
                    "embedding": to_numpy(embedding),
                },
            )
            for label, key, positions, embedding in zip(state.scenes, keys, places, embeddings, strict=True)
        )
        context, anchors = None, sum(map(len, places))
        if anchors and make_schedule(state.iterations, options).coded(state.iteration):
            context = coded_context(state, ContextConfig.of(options, decoders.width, context_hidden))
        precision = options.decoder_precision
        weights = decoders.state_dict() if anchors else {}  # which nothing needs any more
        group = GroupAttributes(
            scenes,
            PositionGrid.lattice(options.voxel, np.concatenate(places)),
            context=context,
            decoders=round_arrays({name: to_numpy(v) for name, v in weights.items()}, precision),
            metadata={
                "decoders": decoders_metadata(decoders, precision),
                "scenes": {
                    label.name: {
                        "background": list(label.background),
                        "light": None if label.light is None else list(label.light),
                    }
                    for label in state.scenes
                },
            },
            culling=context is not None and culls(options),
            plain_positions=options.positions == "float32",
        )
        return EcongsModel([Group(round_group(group), state.device)])

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.scalars["rate_factor"] = self.control.factor
        state.scalars["hidden"] = [self.decoders.hidden, self.context_hidden]
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        super().resume(checkpoint)
        self.control.factor = float(checkpoint.scalars["rate_factor"])


GROWTH_WIDTH, GROWTH_ITERATIONS = 200, 3_000
"""Width of views and iterations per scene for which the option ``growth_gradient`` is meant."""


def growth_threshold(group: Sequence[SceneInput], options: EcongsOptions, iterations: int) -> float:
    """Screen-space gradient (NDC) from which an offset grows an anchor.

    A move by one pixel changes as many pixels at every resolution; over the mean of all pixels, and in NDC,
    its gradient is inversely proportional to the width. A shorter fit cannot train as many anchors.
    """
    if not options.growth_adapts:
        return options.growth_gradient
    widths = [camera.width for scene in group for camera in scene.train.cameras]
    pixel = GROWTH_WIDTH * len(widths) / sum(widths)
    return options.growth_gradient * pixel * math.sqrt(GROWTH_ITERATIONS * len(group) / iterations)


def culls(options: EcongsOptions) -> bool:
    """Whether an anchor shows the same of its Gaussians in every view, so that the others need no offsets."""
    return not options.view_direction and options.storage == "hybrid"


def make_schedule(iterations: int, options: EcongsOptions) -> Schedule:
    """Phases of a fit."""
    return Schedule(
        iterations,
        options.context,
        options.growth_stop,
        options.rounding,
        options.growth_pauses,
        context_share=options.context_start,
        decay=options.decay,
    )


def make_decoders(options: EcongsOptions, hidden: int, generator: torch.Generator) -> Decoders:
    """The networks at their start."""
    bias = options.shading_bias
    return Decoders(
        options.features,
        options.offsets,
        options.embedding,
        hidden=hidden,
        view_direction=options.view_direction,
        direction_start=options.direction_start,
        offset_color=options.offset_color,
        storage=options.storage,
        shading_bias=(bias, bias, raw_specular(options.specular_start), 0.0),
        start_opacity=options.start_opacity,
        generator=generator,
    )
