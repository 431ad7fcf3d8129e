"""Training one scene: the loop of the 3DGS paper, resumable bit for bit."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB, WHITE
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.gaussian_splatting.densify import GradientGrowth, GrowthRules
from econgs_bench.methods.gaussian_splatting.gaussians import DrawnGaussians, GaussianTrainer
from econgs_bench.methods.gaussian_splatting.initialise import first_gaussians, first_points
from econgs_bench.methods.gaussian_splatting.model import GaussianModel, SceneGaussians, SplatModel
from econgs_bench.methods.gaussian_splatting.schedule import Schedule
from econgs_bench.methods.gaussian_splatting.spec import GaussianOptions, HarmonicsOptions
from econgs_bench.methods.interface import Refused, SceneInput
from econgs_bench.methods.shared.densification import Densification
from econgs_bench.methods.shared.pruning import Prunable
from econgs_bench.methods.shared.training import (
    TrainingState,
    are_transparent,
    chosen_background,
    training_images,
)

PARAMETERS = ("means", "log_scales", "quats", "logits", "sh_dc", "sh_rest")
LEARNING_RATES = {"log_scales": 5e-3, "quats": 1e-3, "sh_dc": 2.5e-3}
"""Published learning rates of what no option sets."""
POSITION_DECAY = 0.01
"""Last learning rate of positions, as a fraction of the first."""


class HarmonicsTrainer(GaussianTrainer):
    """A fit of Gaussians with spherical harmonics, whatever decides on their number.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Attributes:
        first_learning_rates: parameter that is optimised now → learning rate while growing.

    Raises:
        Refused: no views, or no initial points.
    """

    options: HarmonicsOptions
    first_learning_rates: dict[str, float]

    def __init__(
        self, scene: SceneInput, options: HarmonicsOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__([scene], options, iterations, seed, device)
        self.scene = scene
        self.background = chosen_background(options.background, scene)
        self.schedule = self._schedule(iterations)
        self.images = training_images(scene.train.images, device)
        self.transparent = are_transparent(self.images)
        parameters, self.first_learning_rates = self._start()
        self.optimiser = Adam(
            {name: values.to(device) for name, values in parameters.items()}, self.first_learning_rates
        )
        self.densification = self._densification()

    @abstractmethod
    def _schedule(self, iterations: int) -> Schedule:
        """Phases of the fit."""

    @abstractmethod
    def _first(self) -> dict[str, torch.Tensor]:
        """First Gaussians, on the CPU (shapes as in ``model.SceneGaussians``)."""

    @abstractmethod
    def _densification(self) -> Densification[Any, DrawnGaussians]:
        """What decides on the number of Gaussians."""

    def _start(self) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        """First parameters, one row per Gaussian, and their learning rates."""
        parameters = self._first()
        rates = LEARNING_RATES | {
            "means": 0.0,
            "logits": self.options.opacity_lr,
            "sh_rest": self.options.sh_rest_lr,
        }
        return {name: parameters[name] for name in PARAMETERS}, rates

    def draw(self) -> DrawnGaussians:
        view = self.next_view()
        back = self.color_of(self.background)
        return self.drawn(self.scene.train.cameras[view], self.images[view].to(self.device), back)

    def drawn(self, camera: Camera, truth: torch.Tensor, back: RGB | torch.Tensor) -> DrawnGaussians:
        """A view (H, W, 4), drawn and compared."""
        splats, offset = self.splat(self.in_view(camera), camera)
        losses = self.view_losses(splats.features, splats.alpha, truth, back, self.transparent)
        return DrawnGaussians(losses=losses, camera=camera, offset=offset, radii=splats.radii)

    def in_view(self, camera: Camera) -> Gaussians:
        """The Gaussians as they are now, with their colors in a view; differentiable."""
        return self.gaussians(self.colors(camera))

    def gaussians(self, colors: torch.Tensor) -> Gaussians:
        """The Gaussians as they are now, with colors (N, C) of a view; differentiable."""
        now = self.optimiser
        return Gaussians(now["means"], now["quats"], now["log_scales"].exp(), now["logits"].sigmoid(), colors)

    def colors(self, camera: Camera) -> torch.Tensor:
        """(N, 3) colors of the Gaussians in a view; differentiable."""
        now, degree = self.optimiser, self.schedule.degree(self.iteration)
        position = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        return spherical_harmonics(degree, now["means"], position, now["sh_dc"], now["sh_rest"])

    def prunable(self) -> Iterable[Prunable]:
        def kept_in_view(camera: Camera, kept: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
            rows = kept.nonzero()[:, 0]
            return self.in_view(camera).of(rows), rows

        views = self.pruning_views(self.scene, self.images, self.transparent, kept_in_view)
        yield Prunable(self.count, [views], self.keep)

    def views(self) -> list[int]:
        return self.shuffled(len(self.scene.train))

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        factor = self.schedule.settled(self.iteration, self.options.last_lr_share)
        rates = {name: factor * rate for name, rate in self.first_learning_rates.items()}
        first = self.options.position_lr * self.scene.extent
        rates["means"] = self.schedule.decayed(self.iteration, first, POSITION_DECAY * first)
        return rates

    @staticmethod
    def restored(state: TrainingState, options: HarmonicsOptions) -> SplatModel:
        """Every Gaussian, in float32."""
        return GaussianModel([plain_gaussians(state, options.sh_degree)])


class Trainer(HarmonicsTrainer):
    """A fit of 3DGS. Methods that begin as 3DGS build on it: vq-3dgs, ivr-gs.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Raises:
        Refused: no views, no initial points, or too many of them.
    """

    options: GaussianOptions

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

    def _densification(self) -> GradientGrowth:
        return GradientGrowth(self, GrowthRules.of(self.options, self.scene.extent))


def plain_gaussians(state: TrainingState, sh_degree: int) -> SceneGaussians:
    """The scene of a fit of 3DGS, or of the part of a fit that is one."""
    (label,) = state.scenes
    values = {name: state.value(name) for name in PARAMETERS}
    return SceneGaussians(label.name, label.background, sh_degree, **values)
