"""Training one scene: the loop of the 3DGS paper, resumable bit for bit."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable

import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB, WHITE
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.rasterise import SplatImages, rasterise
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.gaussian_splatting.densify import GrowthRules, GrowthStatistics, capped_logits, grow
from econgs_bench.methods.gaussian_splatting.initialise import first_gaussians, first_points
from econgs_bench.methods.gaussian_splatting.model import GaussianModel, SceneGaussians, SplatModel
from econgs_bench.methods.gaussian_splatting.schedule import Schedule
from econgs_bench.methods.gaussian_splatting.spec import GaussianOptions, HarmonicsOptions
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.shared.rent import Holding
from econgs_bench.methods.shared.training import (
    CHECK_EVERY,
    TrainingLoop,
    TrainingState,
    are_transparent,
    training_images,
    under,
)

PARAMETERS = ("means", "log_scales", "quats", "logits", "sh_dc", "sh_rest")
LEARNING_RATES = {"log_scales": 5e-3, "quats": 1e-3, "sh_dc": 2.5e-3}
"""Published rates of what no option sets."""
POSITION_DECAY = 0.01
"""Positions end at this fraction of their first rate."""


class HarmonicsTrainer(TrainingLoop):
    """A fit of Gaussians with spherical harmonics, without the rules that decide on their number.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Attributes:
        first_rates: learning rates of the parameters that are optimised now, as they are while growing.

    Raises:
        Refused: no views, or no initial points.
    """

    options: HarmonicsOptions
    schedule: Schedule
    first_rates: dict[str, float]

    def __init__(
        self, scene: SceneInput, options: HarmonicsOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__([scene], iterations, seed, device)
        self.scene, self.options = scene, options
        self.background = self.chosen_background(scene)
        self.schedule = self._schedule(iterations)
        self.images = training_images(scene.train.images, device)
        self.transparent = are_transparent(self.images)
        parameters, self.first_rates = self._start()
        self.optimiser = Adam(
            {name: values.to(device) for name, values in parameters.items()}, self.first_rates
        )

    @abstractmethod
    def _schedule(self, iterations: int) -> Schedule:
        """Phases of the fit."""

    @abstractmethod
    def _first(self) -> dict[str, torch.Tensor]:
        """First Gaussians, on the CPU (shapes as in ``model.SceneGaussians``)."""

    @abstractmethod
    def _control(self) -> None:
        """Change the number of Gaussians, after the optimiser's step."""

    def _record(self, gradients: torch.Tensor, radii: torch.Tensor, camera: Camera) -> None:
        """Take the gradients of screen offsets (N, 2) in a view, where :meth:`Schedule.collects` asks."""

    def _forget(self) -> None:
        """Statistics begin anew, with a row for each Gaussian there is now."""

    def _start(self) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        """First parameters, one row per Gaussian, and their learning rates."""
        parameters = self._first()
        rates = LEARNING_RATES | {
            "means": 0.0,
            "logits": self.options.opacity_lr,
            "sh_rest": self.options.sh_rest_lr,
        }
        return {name: parameters[name] for name in PARAMETERS}, rates

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are optimised now."""
        return tuple(self.optimiser.parameters)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.optimiser["means"])

    def step(self) -> dict[str, float]:
        self.iteration += 1
        self.settle_rent()
        view = self.next_view()
        camera = self.scene.train.cameras[view]
        back = self.background_color()
        parts, offset, radii = self._losses(camera, self.images[view].to(self.device), back)
        report = self.report(parts)
        loss = sum(parts.values(), torch.zeros((), device=self.device))
        if loss.requires_grad:
            self.optimiser.zero_grad()
            loss.backward()
            if offset is not None and offset.grad is not None:
                self._record(offset.grad, radii, camera)
            self._set_rates()
            self.optimiser.step()
        self._control()
        if self.iteration % CHECK_EVERY == 0:
            self.check_finite()
        return report

    def _losses(
        self, camera: Camera, truth: torch.Tensor, back: RGB | torch.Tensor
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor | None, torch.Tensor]:
        """Parts of the loss against a view (H, W, 4), screen offsets that densification reads, radii."""
        splats, offset = self._splat(self._colors(camera), camera)
        losses = self.view_losses(splats.features, splats.alpha, truth, back, self.transparent)
        return losses, offset, splats.radii

    def _splat(self, features: torch.Tensor, camera: Camera) -> tuple[SplatImages, torch.Tensor | None]:
        """Features splatted, and the screen offsets of :meth:`_losses`."""
        now = self.optimiser
        offset = None
        if self.schedule.collects(self.iteration):
            offset = torch.zeros((self.count, 2), device=self.device, requires_grad=True)
        try:
            splats = rasterise(
                now["means"],
                now["quats"],
                now["log_scales"].exp(),
                now["logits"].sigmoid(),
                features,
                camera,
                screen_offset=offset,
                low_pass=self.fit_low_pass,
            )
        except ValueError:
            self.check_finite()  # the usual reason; any other is a fault of the program
            raise
        return splats, offset

    def _colors(self, camera: Camera) -> torch.Tensor:
        now, degree = self.optimiser, self.schedule.degree(self.iteration)
        position = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        return spherical_harmonics(degree, now["means"], position, now["sh_dc"], now["sh_rest"])

    def holdings(self) -> Iterable[Holding]:
        scene = self.rent_scene(self.scene, self.images, self.transparent, self._frame)
        yield Holding(self.count, [scene], self._keep)

    def _keep(self, kept: torch.Tensor) -> None:
        self.optimiser.keep(kept, self.names)
        self._forget()

    def _frame(self, camera: Camera, kept: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
        """What :data:`.methods.shared.rent.Frame` asks for."""
        now, rows = self.optimiser, kept.nonzero()[:, 0]
        scales, opacities = now["log_scales"].exp(), now["logits"].sigmoid()
        every = (now["means"], now["quats"], scales, opacities, self._colors(camera))
        return Gaussians(*(values.index_select(0, rows) for values in every)), rows

    def views(self) -> list[int]:
        return self.shuffled(len(self.scene.train))

    def _set_rates(self) -> None:
        """Learning rates of this iteration."""
        factor = self.schedule.settled(self.iteration, self.options.last_lr_share)
        rates = {name: factor * rate for name, rate in self.first_rates.items()}
        first = self.options.position_lr * self.scene.extent
        rates["means"] = self.schedule.decayed(self.iteration, first, POSITION_DECAY * first)
        self.optimiser.rates = rates

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    def restored(state: TrainingState, options: HarmonicsOptions) -> SplatModel:
        """Every Gaussian, in float32."""
        return GaussianModel([plain_gaussians(state, options.sh_degree)])


class Trainer(HarmonicsTrainer):
    """State of a fit: parameters, optimiser, densification statistics, order of views, random state.

    Methods that begin as 3DGS build on it: vq-3dgs, ivr-gs.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Raises:
        Refused: no views, no initial points, or too many of them.
    """

    options: GaussianOptions

    def __init__(
        self, scene: SceneInput, options: GaussianOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__(scene, options, iterations, seed, device)
        self.rules = GrowthRules(
            gradient=options.growth_gradient,
            dense_scale=options.dense_fraction * scene.extent,
            prune_opacity=options.prune_opacity,
            extent=scene.extent,
            limit=options.max_gaussians,
        )
        self._forget()

    def _schedule(self, iterations: int) -> Schedule:
        return Schedule(
            iterations,
            sh_degree=self.options.sh_degree,
            resets=self.options.opacity_reset,
            early_reset=self.background == WHITE,
            least_interval=self.options.reset_interval,
            decay=self.options.decay,
        )

    def _first(self) -> dict[str, torch.Tensor]:
        points, colors = first_points(self.scene, self.options, self.generator)
        limit = self.options.max_gaussians
        if 0 < limit < len(points):
            raise Refused(f"{len(points)} initial points are more than max_gaussians = {limit}")
        scale, opacity = self.options.start_scale, self.options.start_opacity
        return first_gaussians(points, colors, self.scene.extent, scale=scale, opacity=opacity)

    def stage(self) -> str:
        if self.count == 0:
            return "no Gaussians left"
        if not self.schedule.collects(self.iteration + 1):
            return "refinement"
        return f"growth, stopped at {self.rules.limit} Gaussians" if self.limited else "growth"

    def _control(self) -> None:
        if self.schedule.grows(self.iteration):
            self._grow()
        if self.schedule.resets_opacity(self.iteration):
            self.optimiser.overwrite("logits", capped_logits(self.optimiser["logits"]))

    def _forget(self) -> None:
        self.statistics = GrowthStatistics.zeros(self.count, self.device)

    def _record(self, gradients: torch.Tensor, radii: torch.Tensor, camera: Camera) -> None:
        """Add a view to the statistics that densification reads."""
        self.statistics.record(gradients, radii, camera.width, camera.height)

    def _grow(self, also: torch.Tensor | None = None) -> None:
        self.check_finite()
        growth = grow(
            {name: self.optimiser[name].detach() for name in self.names},
            self.statistics,
            self.rules,
            self.schedule.prunes_large(self.iteration),
            self.generator,
            also,
        )
        self.optimiser.keep(growth.keep, self.names)
        self.optimiser.append(growth.added)
        self._forget()
        self.limited |= growth.limited

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.arrays |= {f"statistics/{name}": v.clone() for name, v in vars(self.statistics).items()}
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        super().resume(checkpoint)
        statistics = under("statistics/", self.arrays(checkpoint))
        self.statistics = GrowthStatistics(**{name: values.clone() for name, values in statistics.items()})


def plain_gaussians(state: TrainingState, sh_degree: int) -> SceneGaussians:
    """The scene of a fit of 3DGS, or of the part of a fit that is one."""
    (label,) = state.scenes
    values = {name: state.value(name) for name in PARAMETERS}
    return SceneGaussians(label.name, label.background, sh_degree, **values)
