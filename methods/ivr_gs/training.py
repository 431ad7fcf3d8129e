"""Both stages of iVR-GS: 3DGS with normals, then Blinn-Phong attributes around a palette color."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB, WHITE
from econgs_bench.econgs.anchors.decoders import OffsetColor
from econgs_bench.econgs.anchors.shading import MIN_NORMAL, Factors, raw_specular
from econgs_bench.econgs.losses import ssim
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.econgs.splat.rasterise import SplatImages
from econgs_bench.methods.gaussian_splatting.densify import GradientGrowth, GrowthRules
from econgs_bench.methods.gaussian_splatting.gaussians import DrawnGaussians
from econgs_bench.methods.gaussian_splatting.training import LEARNING_RATES, Trainer
from econgs_bench.methods.interface import Checkpoint, SceneInput
from econgs_bench.methods.ivr_gs.losses import mean_over, normal_loss, smoothness_loss
from econgs_bench.methods.ivr_gs.model import (
    IvrModel,
    ShadedGaussians,
    Stored,
    activated,
    attributes_with_codebooks,
    ready,
)
from econgs_bench.methods.ivr_gs.schedule import IvrSchedule
from econgs_bench.methods.ivr_gs.spec import IvrOptions
from econgs_bench.methods.shared.pruning import GaussiansInView, PruningViews
from econgs_bench.methods.shared.training import SceneLabel, TrainingState

GEOMETRY = ("means", "log_scales", "quats", "logits", "normals")
SHADING = ("offset_color", "ambient", "diffuse", "specular", "shininess")
NORMAL_LR = 0.01
FIRST_SHININESS = 1.0
_SSIM_SHARE = 0.2  # of the alpha mask's loss; the published one's other part has no gradient


class IvrTrainer(Trainer):
    """A fit of one scene; arguments as for 3DGS.

    The first stage is that of 3DGS with a normal per Gaussian, learned from the depth map. The second has a
    fresh optimiser, no spherical harmonics, and learns what shades each Gaussian.
    """

    options: IvrOptions
    schedule: IvrSchedule

    def __init__(
        self, scene: SceneInput, options: IvrOptions, iterations: int, seed: int, device: str
    ) -> None:
        attributes_with_codebooks(options.quantised)  # refuses names that are none
        super().__init__(scene, options, iterations, seed, device)
        self.palette = _mean_color(self.images).to(device)
        self.light = self.labels[0].light

    def _schedule(self, iterations: int) -> IvrSchedule:
        return IvrSchedule(
            iterations,
            sh_degree=self.options.sh_degree,
            resets=self.options.opacity_reset,
            early_reset=self.background == WHITE,
            least_interval=self.options.reset_interval,
            grows_shaded=self.options.shaded_growth,
            decay=self.options.decay,
        )

    def _start(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        parameters, rates = super()._start()
        normals = torch.randn(parameters["means"].shape, generator=self.generator)
        parameters["normals"] = torch.nn.functional.normalize(normals, dim=1)
        return parameters, rates | {"normals": NORMAL_LR}

    def _densification(self) -> GradientGrowth:
        rules = GrowthRules.of(self.options, self.scene.extent)
        return GradientGrowth(
            self, rules, (self.options.normal_gradient, self.options.shaded_normal_gradient)
        )

    def stage(self) -> str:
        if not self.schedule.shaded(self.iteration + 1) or self.count == 0:
            return super().stage()
        return "shading, growth" if self.schedule.collects(self.iteration + 1) else "shading"

    @property
    def shading(self) -> bool:
        """Whether the second stage has begun."""
        return "ambient" in self.names

    def begin_step(self) -> None:
        if self.schedule.shaded(self.iteration) and not self.shading:
            self._begin_shading({name: self.optimiser[name].detach().clone() for name in GEOMETRY})
        super().begin_step()

    def _begin_shading(self, geometry: dict[str, Tensor]) -> None:
        """A fresh optimiser for what the second stage learns."""
        shading = first_shading(geometry["means"], self.options)
        rates = {name: LEARNING_RATES[name] for name in ("log_scales", "quats")}
        rates |= {"means": 0.0, "logits": self.options.opacity_lr, "normals": NORMAL_LR}
        self.first_learning_rates = rates | dict.fromkeys(SHADING, self.options.shading_lr)
        self.optimiser = Adam(geometry | shading, self.first_learning_rates)
        self.densification.reset()

    # ------------------------------------------------------------------ losses

    def drawn(self, camera: Camera, truth: Tensor, back: RGB | Tensor) -> DrawnGaussians:
        now = self.optimiser
        normals = now["normals"]
        unit = normals / torch.linalg.vector_norm(normals, dim=1, keepdim=True).clamp(min=MIN_NORMAL)
        if self.shading:
            scene = self._shaded()
            features = [self._seen(scene, camera), unit, scene.offsets, scene.coefficients[:, :3]]
        else:
            features = [self.colors(camera), unit]
        splats, offset = self.splat(self.gaussians(torch.cat(features, dim=1)), camera)
        losses = self._common_losses(splats, camera, truth, back)
        if self.shading:
            offsets, coefficients = splats.features[..., 6:9], splats.features[..., 9:12]
            opaque = truth[..., 3] > 0
            losses["offset colors"] = self._weight("offset") * mean_over(offsets.square(), opaque)
            losses["smoothness"] = self._weight("smoothness") * smoothness_loss(coefficients, truth[..., :3])
            if bool((seen := splats.radii > 0).any()):
                losses["opacity"] = self._weight("opacity") * scene.opacities[seen].mean()
        return DrawnGaussians(losses=losses, camera=camera, offset=offset, radii=splats.radii)

    def _common_losses(
        self, splats: SplatImages, camera: Camera, truth: Tensor, back: RGB | Tensor
    ) -> dict[str, Tensor]:
        """Losses of both stages: picture, mask and normals."""
        losses = self.view_losses(splats.features[..., :3], splats.alpha, truth, back, self.transparent)
        weight = _SSIM_SHARE * self._weight("mask")
        if weight:
            losses["mask"] = weight * (1.0 - ssim(splats.alpha[..., None], truth[..., 3:].contiguous()))
        weight = self._weight("normal")
        if weight:
            normals = splats.features[..., 3:6]
            losses["normals"] = weight * normal_loss(normals, splats.depth, splats.alpha, camera)
        return losses

    def _weight(self, part: str) -> float:
        return float(getattr(self.options, f"{part}_weight"))

    def pruning_views(
        self, source: SceneInput, images: Tensor, transparent: bool, gaussians: GaussiansInView
    ) -> PruningViews:
        views = super().pruning_views(source, images, transparent, gaussians)
        return replace(views, asks_alpha=transparent and (views.asks_alpha or self.options.mask_weight > 0.0))

    def _shaded(self) -> ShadedGaussians:
        parameters = {name: self.optimiser[name] for name in self.names}
        return shaded_gaussians(self.labels[0], self.palette, parameters, self.options.offset_color)

    def colors(self, camera: Camera) -> Tensor:
        return self._seen(self._shaded(), camera) if self.shading else super().colors(camera)

    def _seen(self, scene: ShadedGaussians, camera: Camera) -> Tensor:
        """(N, 3) colors of the second stage in a view."""
        eye = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        return scene.colors(eye, self.palette, self.light, Factors())

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    @torch.no_grad()
    def restored(state: TrainingState, options: IvrOptions) -> Any:  # type: ignore[override]
        """In the first stage as 3DGS, then shaded, at the end as it will be stored."""
        finished = state.iteration == state.iterations
        shading = "optimiser/ambient/0/value" in state.arrays
        if not shading and not finished:
            return Trainer.restored(state, options)
        now = {name: state.value(name) for name in (*GEOMETRY, *(SHADING if shading else ()))}
        if not shading:  # too short a budget for a second stage
            now |= first_shading(now["means"], options)
        (label,) = state.scenes
        if not finished:
            palette = torch.tensor(state.scalars["palette"], device=state.device)
            return IvrModel([shaded_gaussians(label, palette, now, options.offset_color)], None)
        visible = now["logits"].sigmoid() >= MIN_ALPHA
        raw = {name: values[visible] for name, values in columns(now).items()}
        normals = raw["normal"]
        length = torch.linalg.vector_norm(normals, dim=1, keepdim=True)
        raw["normal"] = normals / length.clamp(min=MIN_NORMAL)
        stored = Stored.of(label, state.scalars["palette"], now["means"][visible], raw, options)
        return IvrModel([ready(stored.coded, state.device)], [stored])

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.scalars["palette"] = self.palette.tolist()
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        arrays = self.arrays(checkpoint)
        if "optimiser/ambient/0/value" in arrays:
            self._begin_shading({name: arrays[f"optimiser/{name}/0/value"].clone() for name in GEOMETRY})
        super().resume(checkpoint)


def first_shading(means: Tensor, options: IvrOptions) -> dict[str, Tensor]:
    """First shading attributes."""

    def full(value: float, width: int = 1) -> Tensor:
        return torch.full((len(means), width), value, device=means.device)

    return {
        "offset_color": full(0.0, 3),
        "ambient": full(options.shading_start),
        "diffuse": full(options.shading_start),
        "specular": full(raw_specular(options.specular_start)),
        "shininess": full(FIRST_SHININESS),
    }


def columns(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The second stage's parameters as columns of the model; differentiable."""
    unit = torch.nn.functional.normalize(parameters["quats"], dim=1)
    return {
        "opacity": parameters["logits"][:, None],
        "scale": parameters["log_scales"],
        "rotation real": unit[:, :1],
        "rotation imaginary": unit[:, 1:],
        "normal": parameters["normals"],
        **{name.replace("_", " "): parameters[name] for name in SHADING},
    }


def shaded_gaussians(
    label: SceneLabel, palette: Tensor, parameters: Mapping[str, Tensor], offset_color: OffsetColor
) -> ShadedGaussians:
    """A scene of the second stage; differentiable."""
    values = activated(columns(parameters), offset_color)
    return ShadedGaussians(label.name, label.background, label.light, palette, parameters["means"], **values)


def _mean_color(images: Tensor) -> Tensor:
    """(3,) mean color of (views, H, W, 4) premultiplied images, weighted by alpha; white if all are empty."""
    alpha = images[..., 3].double().sum()
    if float(alpha) <= 0.0:
        return torch.ones(3)
    return (images[..., :3].double().sum((0, 1, 2)) / alpha).float().clamp(0.0, 1.0)
