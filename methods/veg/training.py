"""Both stages of VEG: geometry, scalars and normals first, then what shades each Gaussian."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.anchors.shading import MIN_NORMAL
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.econgs.splat.rasterise import SplatImages, rasterise
from econgs_bench.methods.gaussian_splatting.densify import GrowthRules, GrowthStatistics, grow
from econgs_bench.methods.gaussian_splatting.training import LEARNING_RATES, POSITION_DECAY
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.ivr_gs.losses import normal_loss, smoothness_loss
from econgs_bench.methods.ivr_gs.training import NORMAL_RATE
from econgs_bench.methods.shared.rent import Holding
from econgs_bench.methods.shared.training import (
    CHECK_EVERY,
    TrainingLoop,
    TrainingState,
    are_transparent,
    training_images,
    under,
)
from econgs_bench.methods.veg.appearance import Appearance, scene_as_json, scene_from_json
from econgs_bench.methods.veg.model import (
    Field,
    Group,
    HasColumns,
    ScalarGaussians,
    Stored,
    VegModel,
    activated,
    columns,
    visible_rows,
)
from econgs_bench.methods.veg.schedule import VegSchedule
from econgs_bench.methods.veg.spec import VegOptions
from econgs_bench.methods.veg.start import initial_parameters

SHADING = ("ambient", "diffuse", "specular", "shininess")
PARAMETERS = ("means", "log_scales", "quats", "normals", "scalars", "opacities", *SHADING)


class _Scene:
    """One scene of the group: its views and its look."""

    def __init__(self, source: SceneInput, background: RGB | None, options: VegOptions, device: str) -> None:
        self.source, self.background = source, background
        self.look = Appearance.of(source.scene, options.table_size, device)
        self.images = training_images(source.train.images, device)
        self.transparent = are_transparent(self.images)


class VegTrainer(TrainingLoop):
    """State of a fit: parameters, optimiser, densification statistics, order of views, random state.

    Arguments: the scenes of one variable, resolved options, and those of
    :class:`.methods.shared.training.TrainingLoop`. Each step sees one view of one scene.

    Raises:
        Refused: a scene without views, volume or transfer function; no initial points, or too many of them.
    """

    options: VegOptions
    schedule: VegSchedule

    def __init__(
        self, group: Sequence[SceneInput], options: VegOptions, iterations: int, seed: int, device: str
    ) -> None:
        for scene in group:
            _check(scene)
        super().__init__(group, iterations, seed, device)
        self.options = options
        self.schedule = VegSchedule(iterations, decay=options.decay)
        self.scenes = [_Scene(scene, self.chosen_background(scene), options, device) for scene in group]
        self.extent = max(scene.extent for scene in group)
        self.rules = GrowthRules(
            gradient=options.growth_gradient,
            dense_scale=options.dense_fraction * self.extent,
            prune_opacity=options.prune_opacity,
            extent=self.extent,
            limit=options.max_gaussians,
        )
        parameters = initial_parameters(group, options, self.generator)
        self.optimiser = self._optimiser({name: parameters[name].to(device) for name in PARAMETERS})
        self._forget()

    def _optimiser(self, parameters: Mapping[str, Tensor]) -> Adam:
        options = self.options
        rates = {name: LEARNING_RATES[name] for name in ("log_scales", "quats")}
        rates |= {"means": 0.0, "normals": NORMAL_RATE, "scalars": options.scalar_lr}
        rates |= {"opacities": options.opacity_lr, **dict.fromkeys(SHADING, options.shading_lr)}
        return Adam(parameters, rates)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.optimiser["means"])

    @property
    def shading(self) -> bool:
        """Whether the second stage has begun."""
        return self.schedule.shaded(self.iteration)

    def stage(self) -> str:
        if self.count == 0:
            return "no Gaussians left"
        shading = self.schedule.shaded(self.iteration + 1)
        if not self.schedule.collects(self.iteration + 1):
            return "shading" if shading else "refinement"
        growth = f"growth, stopped at {self.rules.limit} Gaussians" if self.limited else "growth"
        return f"shading, {growth}" if shading else growth

    def views(self) -> list[tuple[int, int]]:
        """Pairs of scene and view."""
        pairs = [(i, view) for i, scene in enumerate(self.scenes) for view in range(len(scene.images))]
        return [pairs[i] for i in self.shuffled(len(pairs))]

    def step(self) -> dict[str, float]:
        self.iteration += 1
        if self.shading and not self.schedule.shaded(self.iteration - 1):
            self.optimiser = self._optimiser({name: self.optimiser[name].detach() for name in PARAMETERS})
            self._forget()
        self.settle_rent()
        place, view = self.next_view()
        scene = self.scenes[place]
        self.background = scene.background
        camera = scene.source.train.cameras[view]
        rows = visible_rows(self.optimiser["scalars"].detach().sigmoid(), [scene.look])
        truth, back = scene.images[view].to(self.device), self.background_color()
        parts, offset, radii = self._losses(scene, rows, camera, truth, back)
        report = self.report(parts)
        loss = sum(parts.values(), torch.zeros((), device=self.device))
        if loss.requires_grad:
            self.optimiser.zero_grad()
            loss.backward()
            if offset is not None and offset.grad is not None:
                self._record(rows, offset.grad, radii, camera)
            first = self.options.position_lr * self.extent
            self.optimiser.rates["means"] = self.schedule.decayed(
                self.iteration, first, POSITION_DECAY * first
            )
            self.optimiser.step()
        if self.schedule.grows(self.iteration):
            self._grow()
        if self.iteration % CHECK_EVERY == 0:
            self.check_finite()
        return report

    # ------------------------------------------------------------------ losses

    def _losses(
        self, scene: _Scene, rows: Tensor, camera: Camera, truth: Tensor, back: RGB | Tensor
    ) -> tuple[dict[str, Tensor], Tensor | None, Tensor]:
        """Parts of the loss against a view (H, W, 4), screen offsets that densification reads, radii.

        The last two have a row for each of the Gaussians ``rows``, which the scene shows.
        """
        options = self.options
        gaussians = self._gaussians(rows)
        eye = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        colors, opacities = gaussians.seen([scene.look], eye)
        normals = bool(options.normal_weight)
        coefficients = self.shading and bool(options.smoothness_weight)
        features = [colors]
        if normals:
            length = torch.linalg.vector_norm(gaussians.normals, dim=1, keepdim=True)
            features.append(gaussians.normals / length.clamp(min=MIN_NORMAL))
        if coefficients:
            assert gaussians.factors is not None
            features.append(gaussians.factors[:, :3])
        splats, offset = self._splat(gaussians, opacities, torch.cat(features, dim=1), camera)
        drawn = splats.features
        losses = self.view_losses(drawn[..., :3], splats.alpha, truth, back, scene.transparent)
        if normals:
            apart = normal_loss(drawn[..., 3:6], splats.depth, splats.alpha, camera)
            losses["normals"] = options.normal_weight * apart
        if coefficients:
            losses["smoothness"] = options.smoothness_weight * smoothness_loss(
                drawn[..., -3:], truth[..., :3]
            )
        if self.shading and options.opacity_weight and bool((seen := splats.radii > 0).any()):
            losses["opacity"] = options.opacity_weight * opacities[seen].mean()
        return losses, offset, splats.radii

    def _gaussians(self, rows: Tensor) -> ScalarGaussians:
        """Some of the Gaussians, by their indices; differentiable."""
        everything = len(rows) == self.count
        now = {
            name: self.optimiser[name] if everything else self.optimiser[name].index_select(0, rows)
            for name in PARAMETERS
        }
        return scalar_gaussians(now, self.options, self.shading)

    def _splat(
        self, gaussians: ScalarGaussians, opacities: Tensor, features: Tensor, camera: Camera
    ) -> tuple[SplatImages, Tensor | None]:
        offset = None
        if self.schedule.collects(self.iteration):
            offset = torch.zeros((len(gaussians), 2), device=self.device, requires_grad=True)
        try:
            splats = rasterise(
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                opacities,
                features,
                camera,
                screen_offset=offset,
                low_pass=self.fit_low_pass,
            )
        except ValueError:
            self.check_finite()  # the usual reason; any other is a fault of the program
            raise
        return splats, offset

    # ------------------------------------------------------------------ growth

    def _record(self, rows: Tensor, gradients: Tensor, radii: Tensor, camera: Camera) -> None:
        """Add a view to the statistics; it says nothing about Gaussians that its scene does not show."""
        whole = gradients.new_zeros((self.count, 2)).index_copy_(0, rows, gradients)
        sizes = radii.new_zeros(self.count).index_copy_(0, rows, radii)
        self.statistics.record(whole, sizes, camera.width, camera.height)
        normals = self.optimiser["normals"].grad
        if normals is not None:
            self.normal_gradients += torch.linalg.vector_norm(normals, dim=1)

    @torch.no_grad()
    def _grow(self) -> None:
        self.check_finite()
        least = self.options.shaded_normal_gradient if self.shading else self.options.normal_gradient
        parameters = {name: self.optimiser[name].detach() for name in PARAMETERS}
        growth = grow(
            parameters | {"logits": self._greatest_opacities().logit()},
            self.statistics,
            self.rules,
            False,
            self.generator,
            self.normal_gradients / self.statistics.visits.clamp(min=1.0) > least,
        )
        self.optimiser.keep(growth.keep, PARAMETERS)
        self.optimiser.append({name: growth.added[name] for name in PARAMETERS})
        self.limited |= growth.limited
        self._forget()

    def holdings(self) -> Iterable[Holding]:
        scenes = [
            self.rent_scene(one.source, one.images, one.transparent, partial(self._frame, one))
            for one in self.scenes
        ]
        yield Holding(self.count, scenes, self._keep)

    def _keep(self, kept: Tensor) -> None:
        self.optimiser.keep(kept, PARAMETERS)
        self._forget()

    def _frame(self, scene: _Scene, camera: Camera, kept: Tensor) -> tuple[Gaussians, Tensor]:
        """What :data:`.methods.shared.rent.Frame` asks for."""
        shown = visible_rows(self.optimiser["scalars"].detach().sigmoid(), [scene.look])
        rows = shown[kept[shown]]
        gaussians = self._gaussians(rows)
        eye = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        colors, opacities = gaussians.seen([scene.look], eye)
        return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, colors), rows

    def _greatest_opacities(self) -> Tensor:
        """(N,) by which Gaussians are pruned; see :func:`greatest_opacities`."""
        gaussians = scalar_gaussians(self.optimiser, self.options, True)
        return greatest_opacities(gaussians, [scene.look for scene in self.scenes])

    def _forget(self) -> None:
        """Statistics begin anew."""
        self.statistics = GrowthStatistics.zeros(self.count, self.device)
        self.normal_gradients = torch.zeros(self.count, device=self.device)

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    @torch.no_grad()
    def restored(state: TrainingState, options: VegOptions) -> VegModel:
        """While training is under way in float32, at the end as it will be stored."""
        scenes = tuple(scene_from_json(about) for about in state.scalars["definitions"])
        now = {name: state.value(name) for name in PARAMETERS}
        if state.iteration < state.iterations:
            shaded = VegSchedule(state.iterations).shaded(state.iteration)
            field = Field(scalar_gaussians(now, options, shaded), options.table_size)
            return VegModel([Group(scenes, field, None)])
        gaussians = scalar_gaussians(now, options, True)
        looks = [Appearance.of(scene, options.table_size, state.device) for scene in scenes]
        visible = greatest_opacities(gaussians, looks) >= MIN_ALPHA
        raw = {name: values[visible] for name, values in columns(now).items()}
        length = torch.linalg.vector_norm(raw["normal"], dim=1, keepdim=True)
        raw["normal"] = raw["normal"] / length.clamp(min=MIN_NORMAL)
        size = options.codebook_size
        stored = Stored.of(options.opacity_law, options.table_size, now["means"][visible], raw, size)
        return VegModel([Group(scenes, stored.field(state.device), stored)])

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.arrays |= {f"statistics/{name}": v.clone() for name, v in vars(self.statistics).items()}
        state.arrays["normal_gradients"] = self.normal_gradients.clone()
        state.scalars["definitions"] = [
            scene_as_json(replace(one.source.scene, background=one.source.train.background))
            for one in self.scenes
        ]
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        super().resume(checkpoint)
        arrays = self.arrays(checkpoint)
        statistics = under("statistics/", arrays)
        self.statistics = GrowthStatistics(**{name: values.clone() for name, values in statistics.items()})
        self.normal_gradients = arrays["normal_gradients"].clone()


def scalar_gaussians(parameters: HasColumns, options: VegOptions, shading: bool) -> ScalarGaussians:
    """Gaussians of the second stage, or of the first; differentiable.

    In the first stage the scenes' own light shades them, or nothing does; by the law of the product their
    opacity is that of the look-up.
    """
    values: dict[str, Any] = activated(columns(parameters))
    if not shading:
        plain = torch.ones_like(values["factors"])
        values["factors"] = plain if options.first_stage == "light" else None
        if options.opacity_law == "product":
            values["opacities"] = torch.ones_like(values["opacities"])
    return ScalarGaussians(options.opacity_law, parameters["means"], **values)


@torch.no_grad()
def greatest_opacities(gaussians: ScalarGaussians, looks: Sequence[Appearance]) -> Tensor:
    """(N,) the greatest opacity of each Gaussian under some transfer functions (depth), or its own (product).

    A Gaussian that one transfer function hides may be another one's.
    """
    if gaussians.law == "product":
        return gaussians.opacities
    each = [gaussians.opaque([look], [look.extinctions(gaussians.scalars)]) for look in looks]
    return torch.stack(each).amax(dim=0)


def _check(scene: SceneInput) -> None:
    if scene.scene.transfer is None:
        what = "shows isosurfaces" if scene.scene.isosurfaces else "has only views"
        raise Refused(f"veg learns scenes with a transfer function, and scene {scene.name!r} {what}")
    if scene.volume is None:
        raise Refused(f"veg reads the volume itself, and scene {scene.name!r} has only views")
