"""Both stages of VEG: geometry, scalars and normals first, then what shades each Gaussian."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.anchors.shading import MIN_NORMAL
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.methods.gaussian_splatting.densify import GradientGrowth, GrowthRules
from econgs_bench.methods.gaussian_splatting.gaussians import DrawnGaussians, GaussianTrainer
from econgs_bench.methods.gaussian_splatting.training import LEARNING_RATES, POSITION_DECAY
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.ivr_gs.losses import normal_loss, smoothness_loss
from econgs_bench.methods.ivr_gs.training import NORMAL_LR
from econgs_bench.methods.shared.pruning import Prunable
from econgs_bench.methods.shared.training import (
    TrainingState,
    are_transparent,
    chosen_background,
    training_images,
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

    def __init__(self, source: SceneInput, options: VegOptions, device: str) -> None:
        self.source, self.background = source, chosen_background(options.background, source)
        self.look = Appearance.of(source.scene, options.table_size, device)
        self.images = training_images(source.train.images, device)
        self.transparent = are_transparent(self.images)


class VegTrainer(GaussianTrainer):
    """A fit of the scenes of one variable. Each step sees one view of one scene.

    Arguments: the scenes, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

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
        super().__init__(group, options, iterations, seed, device)
        self.schedule = VegSchedule(iterations, decay=options.decay)
        self.scenes = [_Scene(scene, options, device) for scene in group]
        self.extent = max(scene.extent for scene in group)
        parameters = initial_parameters(group, options, self.generator)
        self.optimiser = self._optimiser({name: parameters[name].to(device) for name in PARAMETERS})
        rules = GrowthRules.of(options, self.extent)
        self.densification = GradientGrowth(
            self, rules, (options.normal_gradient, options.shaded_normal_gradient)
        )

    def _optimiser(self, parameters: Mapping[str, Tensor]) -> Adam:
        options = self.options
        rates = {name: LEARNING_RATES[name] for name in ("log_scales", "quats")}
        rates |= {"means": 0.0, "normals": NORMAL_LR, "scalars": options.scalar_lr}
        rates |= {"opacities": options.opacity_lr, **dict.fromkeys(SHADING, options.shading_lr)}
        return Adam(parameters, rates)

    @property
    def shading(self) -> bool:
        """Whether the second stage has begun."""
        return self.schedule.shaded(self.iteration)

    def stage(self) -> str:
        stage = self.densification.stage()
        if self.count == 0 or not self.schedule.shaded(self.iteration + 1):
            return stage
        return "shading" if stage == "refinement" else f"shading, {stage}"

    def views(self) -> list[tuple[int, int]]:
        """Pairs of scene and view."""
        pairs = [(i, view) for i, scene in enumerate(self.scenes) for view in range(len(scene.images))]
        return [pairs[i] for i in self.shuffled(len(pairs))]

    def begin_step(self) -> None:
        if self.shading and not self.schedule.shaded(self.iteration - 1):
            self.optimiser = self._optimiser({name: self.optimiser[name].detach() for name in PARAMETERS})
            self.densification.reset()
        super().begin_step()

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        first = self.options.position_lr * self.extent
        return {"means": self.schedule.decayed(self.iteration, first, POSITION_DECAY * first)}

    def draw(self) -> DrawnGaussians:
        place, view = self.next_view()
        scene, options = self.scenes[place], self.options
        camera = scene.source.train.cameras[view]
        truth, back = scene.images[view].to(self.device), self.color_of(scene.background)
        rows = self._rows(scene)
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
        shape = (gaussians.means, gaussians.quats, gaussians.scales, opacities)
        splats, offset = self.splat(Gaussians(*shape, torch.cat(features, dim=1)), camera)
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
        return DrawnGaussians(
            losses=losses, scene=place, camera=camera, offset=offset, radii=splats.radii, rows=rows
        )

    def _rows(self, scene: _Scene) -> Tensor:
        """(M,) numbers of the Gaussians that a scene shows."""
        return visible_rows(self.optimiser["scalars"].detach().sigmoid(), [scene.look])

    def _gaussians(self, rows: Tensor) -> ScalarGaussians:
        """Some of the Gaussians, by their indices; differentiable."""
        everything = len(rows) == self.count
        now = {
            name: self.optimiser[name] if everything else self.optimiser[name].index_select(0, rows)
            for name in PARAMETERS
        }
        return scalar_gaussians(now, self.options, self.shading)

    def prunable(self) -> Iterable[Prunable]:
        scenes = [
            self.pruning_views(one.source, one.images, one.transparent, partial(self._in_view, one))
            for one in self.scenes
        ]
        yield Prunable(self.count, scenes, self.keep)

    def _in_view(self, scene: _Scene, camera: Camera, kept: Tensor) -> tuple[Gaussians, Tensor]:
        """What :data:`.methods.shared.pruning.GaussiansInView` asks for."""
        shown = self._rows(scene)
        rows = shown[kept[shown]]
        gaussians = self._gaussians(rows)
        eye = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        colors, opacities = gaussians.seen([scene.look], eye)
        return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, colors), rows

    @torch.no_grad()
    def pruning_logits(self) -> Tensor:
        """(N,) logits of the greatest opacities; see :func:`greatest_opacities`."""
        gaussians = scalar_gaussians(self.optimiser, self.options, True)
        return greatest_opacities(gaussians, [scene.look for scene in self.scenes]).logit()

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
        state.scalars["definitions"] = [
            scene_as_json(replace(one.source.scene, background=one.source.train.background))
            for one in self.scenes
        ]
        return state


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
