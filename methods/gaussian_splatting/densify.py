"""Adaptive density control: which Gaussians are cloned, split and pruned (section 5 of the 3DGS paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch

from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.methods.gaussian_splatting.gaussians import DrawnGaussians, GaussianTrainer
from econgs_bench.methods.shared.densification import Densification
from econgs_bench.methods.shared.training import under

SPLIT_SCALE = 1.6
SPLIT_PARTS = 2
LARGE_RADIUS = 20  # pixels
LARGE_SCALE = 0.1  # of the extent
RESET_OPACITY = 0.01


@dataclass
class GrowthStatistics:
    """Statistics of each Gaussian since the last growth event.

    Attributes:
        gradients: (N,) sum of screen-space gradient norms, normalised device coordinates.
        visits: (N,) number of views in which it was visible.
        radii: (N,) its largest radius in pixels.
    """

    gradients: torch.Tensor
    visits: torch.Tensor
    radii: torch.Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str) -> GrowthStatistics:
        return cls(*(torch.zeros(count, device=device) for _ in range(3)))

    def record(self, pixel_gradients: torch.Tensor, radii: torch.Tensor, width: int, height: int) -> None:
        """Add one view: (N, 2) gradients with respect to pixels and (N,) radii.

        The gradient of an invisible Gaussian is zero, so nothing needs to be masked.
        """
        x, y = pixel_gradients.unbind(1)
        # Five times as fast as norm(dim=1).
        self.gradients += (0.5 * width * x).square_().addcmul_(y, y, value=(0.5 * height) ** 2).sqrt_()
        self.visits += radii > 0
        torch.maximum(self.radii, radii.to(self.radii.dtype), out=self.radii)

    def mean_gradients(self) -> torch.Tensor:
        return self.gradients / self.visits.clamp(min=1.0)


class GrowthOptions(Protocol):
    """Options of growth, as :class:`.methods.gaussian_splatting.spec.GaussianOptions` has them."""

    @property
    def growth_gradient(self) -> float: ...
    @property
    def dense_fraction(self) -> float: ...
    @property
    def prune_opacity(self) -> float: ...
    @property
    def max_gaussians(self) -> int: ...


@dataclass(frozen=True)
class GrowthRules:
    """Thresholds of growth and pruning.

    Attributes:
        gradient: mean screen-space gradient from which a Gaussian is cloned or split.
        dense_scale: largest scale that is cloned, not split; scene units.
        prune_opacity: opacity under which it is pruned.
        extent: the scene's extent.
        limit: number of Gaussians at which growth stops; 0 = none.
    """

    gradient: float
    dense_scale: float
    prune_opacity: float
    extent: float
    limit: int

    @classmethod
    def of(cls, options: GrowthOptions, extent: float) -> GrowthRules:
        """The thresholds that options set, in a scene of that extent."""
        return cls(
            gradient=options.growth_gradient,
            dense_scale=options.dense_fraction * extent,
            prune_opacity=options.prune_opacity,
            extent=extent,
            limit=options.max_gaussians,
        )


@dataclass(frozen=True)
class Growth:
    """Changes of a growth event.

    Attributes:
        keep: indices of the Gaussians that stay, ascending.
        added: parameters of the new ones.
        limited: the limit kept some from being cloned or split.
    """

    keep: torch.Tensor
    added: dict[str, torch.Tensor]
    limited: bool


def grow(
    parameters: dict[str, torch.Tensor],
    statistics: GrowthStatistics,
    rules: GrowthRules,
    prune_large: bool,
    generator: torch.Generator,
    also: torch.Tensor | None = None,
) -> Growth:
    """Clone small and split large Gaussians with high gradients, then prune.

    Args:
        parameters: as in ``model.SceneGaussians``, detached.
        statistics: since the last growth event.
        rules: thresholds.
        prune_large: also prune those with a radius over 20 px or a scale over 0.1 x extent.
        generator: CPU generator that places the parts of split Gaussians.
        also: (N,) which Gaussians are cloned or split for another reason.
    """
    gradients = statistics.mean_gradients()
    hot = gradients >= rules.gradient
    if also is not None:
        hot = hot | also
    limited = False
    if rules.limit:
        room = max(0, rules.limit - len(gradients))
        if int(hot.sum()) > room:
            limited = True
            hottest = torch.where(hot, gradients, -1.0).argsort(descending=True, stable=True)[:room]
            hot = torch.zeros_like(hot).index_fill_(0, hottest, True)
    largest = parameters["log_scales"].amax(dim=1).exp()
    clone = hot & (largest <= rules.dense_scale)
    split = hot & ~clone

    clones = {name: values[clone] for name, values in parameters.items()}
    parts = _split({name: values[split] for name, values in parameters.items()}, generator)
    added = {name: torch.cat([clones[name], parts[name]]) for name in parameters}

    keep = ~_prunable(parameters, rules, prune_large) & ~split
    if prune_large:
        keep &= statistics.radii <= LARGE_RADIUS
    stay = ~_prunable(added, rules, prune_large)
    return Growth(keep.nonzero()[:, 0], {name: values[stay] for name, values in added.items()}, limited)


class GradientGrowth(Densification[GaussianTrainer, DrawnGaussians]):
    """Clones and splits Gaussians with high gradients on the screen, and prunes faint and large ones.

    Args:
        fit: the fit.
        rules: thresholds.
        normals: mean gradient of a normal from which its Gaussian grows too, in the first and in the second
            stage of a fit that learns normals.
    """

    def __init__(
        self, fit: GaussianTrainer, rules: GrowthRules, normals: tuple[float, float] | None = None
    ) -> None:
        self.rules, self.normals = rules, normals
        super().__init__(fit)

    def reset(self) -> None:
        self.statistics = GrowthStatistics.zeros(self.fit.count, self.fit.device)
        self.normal_gradients = torch.zeros(self.fit.count, device=self.fit.device)

    def after_backward(self, drawn: DrawnGaussians) -> None:
        if drawn.offset is None or drawn.offset.grad is None:
            return
        gradients, radii = drawn.offset.grad, drawn.radii
        if drawn.rows is not None:  # a view says nothing about Gaussians that its scene does not show
            gradients = gradients.new_zeros((self.fit.count, 2)).index_copy_(0, drawn.rows, gradients)
            radii = radii.new_zeros(self.fit.count).index_copy_(0, drawn.rows, radii)
        self.statistics.record(gradients, radii, drawn.camera.width, drawn.camera.height)
        if self.normals and (normals := self.fit.optimiser["normals"].grad) is not None:
            self.normal_gradients += torch.linalg.vector_norm(normals, dim=1)

    def after_step(self, drawn: DrawnGaussians) -> None:
        schedule, iteration = self.fit.schedule, self.fit.iteration
        if schedule.grows(iteration):
            self.grow()
        if schedule.resets_opacity(iteration):
            self.fit.optimiser.overwrite("logits", capped_logits(self.fit.optimiser["logits"]))
        if schedule.prunes_invisible(iteration):
            self.prune_invisible()

    @torch.no_grad()
    def grow(self) -> None:
        """One growth event."""
        fit, also = self.fit, None
        fit.check_finite()
        if self.normals:
            least = self.normals[fit.schedule.shaded(fit.iteration)]
            also = self.normal_gradients / self.statistics.visits.clamp(min=1.0) > least
        growth = grow(
            {name: fit.optimiser[name].detach() for name in fit.names} | {"logits": fit.pruning_logits()},
            self.statistics,
            self.rules,
            fit.schedule.prunes_large(fit.iteration),
            fit.generator,
            also,
        )
        fit.optimiser.keep(growth.keep, fit.names)
        fit.optimiser.append({name: growth.added[name] for name in fit.names})
        self.reset()
        self.limited |= growth.limited

    def prune_invisible(self) -> None:
        """Remove Gaussians that no pixel shows."""
        seen = self.fit.pruning_logits().sigmoid() >= MIN_ALPHA
        if not bool(seen.all()):
            self.fit.keep(seen)

    def stage(self) -> str:
        if self.fit.count == 0:
            return "no Gaussians left"
        if not self.fit.schedule.collects(self.fit.iteration + 1):
            return "refinement"
        return f"growth, stopped at {self.rules.limit} Gaussians" if self.limited else "growth"

    def state(self) -> dict[str, torch.Tensor]:
        state = {f"statistics/{name}": values for name, values in vars(self.statistics).items()}
        return state | ({"normal_gradients": self.normal_gradients} if self.normals else {})

    def load_state(self, arrays: Mapping[str, torch.Tensor]) -> None:
        self.statistics = GrowthStatistics(
            **{name: values.clone() for name, values in under("statistics/", arrays).items()}
        )
        if self.normals:
            self.normal_gradients = arrays["normal_gradients"].clone()


def capped_logits(logits: torch.Tensor) -> torch.Tensor:
    """Logits of opacities capped at 0.01."""
    return logits.detach().clamp(max=math.log(RESET_OPACITY / (1.0 - RESET_OPACITY)))


def _split(parents: dict[str, torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Two smaller Gaussians for each parent, placed by sampling it."""
    parts = {name: values.repeat(SPLIT_PARTS, *[1] * (values.ndim - 1)) for name, values in parents.items()}
    scales = parts["log_scales"].exp()
    samples = torch.randn(scales.shape, generator=generator).to(scales) * scales
    parts["means"] = parts["means"] + rotate(parts["quats"], samples)
    parts["log_scales"] = (scales / SPLIT_SCALE).log()
    return parts


def rotate(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate (N, 3) vectors by (N, 4) quaternions w x y z, normalised here."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    across = 2.0 * torch.linalg.cross(axis, vectors)
    turned: torch.Tensor = vectors + w * across + torch.linalg.cross(axis, across)
    return turned


def _prunable(parameters: dict[str, torch.Tensor], rules: GrowthRules, prune_large: bool) -> torch.Tensor:
    prunable = parameters["logits"].sigmoid() < rules.prune_opacity
    if prune_large:
        prunable = prunable | (parameters["log_scales"].amax(dim=1).exp() > LARGE_SCALE * rules.extent)
    return prunable
