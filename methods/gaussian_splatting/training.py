"""Training one scene: the loop of the 3DGS paper, resumable bit for bit."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from datasets.camera import Camera
from datasets.scene import RGB, WHITE
from econgs.losses import photometric_loss
from econgs.optim import Adam
from econgs.splat.composite import over
from econgs.splat.rasterise import Rasterised, rasterise
from econgs.splat.sh import spherical_harmonics
from methods.gaussian_splatting.densify import GrowthRules, GrowthStatistics, capped_logits, grow
from methods.gaussian_splatting.initialise import initial_parameters
from methods.gaussian_splatting.model import GaussianModel, SceneGaussians
from methods.gaussian_splatting.schedule import Schedule
from methods.interface import Checkpoint, Diverged, Monitor, OptionValue, Refused, SceneInput

PARAMETERS = ("means", "log_scales", "quats", "logits", "sh_dc", "sh_rest")
LEARNING_RATES = {"log_scales": 5e-3, "quats": 1e-3, "sh_dc": 2.5e-3}
"""Published rates of what no option sets."""
POSITION_DECAY = 0.01
"""Positions end at this fraction of their first rate."""

_BACKGROUNDS: dict[str, RGB] = {"white": WHITE, "black": (0.0, 0.0, 0.0)}
_CHECK_EVERY = 100


class Trainer:
    """State of a fit: parameters, optimiser, densification statistics, order of views, random state.

    Methods that begin as 3DGS build on it: vq-3dgs, ivr-gs.

    Args:
        scene: what is trained.
        options: resolved options of the spec.
        iterations: the budget.
        seed: of the one generator that every choice is drawn from.
        device: "cpu" or "cuda".

    Raises:
        Refused: no views, no initial points, or too many of them.
    """

    def __init__(
        self, scene: SceneInput, options: Mapping[str, OptionValue], iterations: int, seed: int, device: str
    ) -> None:
        if len(scene.train) == 0:
            raise Refused(f"scene {scene.name!r} has no training views")
        self.scene, self.options, self.device = scene, options, device
        choice = str(options["background"])
        self.background = scene.train.background if choice == "scene" else _BACKGROUNDS.get(choice)
        self.schedule = self._schedule(iterations)
        self.rules = GrowthRules(
            gradient=float(options["growth_gradient"]),
            dense_scale=float(options["dense_fraction"]) * scene.extent,
            prune_opacity=float(options["prune_opacity"]),
            extent=scene.extent,
            limit=int(options["max_gaussians"]),
        )
        self.generator = torch.Generator().manual_seed(seed)
        self.images = torch.from_numpy(scene.train.images)
        self.iteration = 0
        self.pending: list[int] = []  # views not yet drawn in this round
        self.limited = False
        parameters, rates = self._start()
        self.optimiser = Adam({name: values.to(device) for name, values in parameters.items()}, rates)
        self.statistics = GrowthStatistics.zeros(self.count, device)

    def _schedule(self, iterations: int) -> Schedule:
        return Schedule(
            iterations,
            sh_degree=int(self.options["sh_degree"]),
            resets=bool(self.options["opacity_reset"]),
            early_reset=self.background == WHITE,
        )

    def _start(self) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        """First parameters, one row per Gaussian, and their learning rates."""
        parameters = initial_parameters(self.scene, self.options, self.generator)
        rates = LEARNING_RATES | {
            "means": 0.0,
            "logits": float(self.options["opacity_lr"]),
            "sh_rest": float(self.options["sh_rest_lr"]),
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

    @property
    def iterations(self) -> int:
        """The whole budget."""
        return self.schedule.iterations

    def run(self, monitor: Monitor) -> None:
        """Train to the end of the budget.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        stage = ""
        while self.iteration < self.iterations:
            if stage != (stage := self._stage()):
                monitor.stage(stage)
            loss = self.step()
            monitor.progress(self.iteration, {"loss": loss}, self.count)
            if monitor.due(self.iteration):
                monitor.pause(self.iteration, self.model, self.checkpoint)
        self._check_finite()

    def _stage(self) -> str:
        if self.count == 0:
            return "no Gaussians left"
        if not self.schedule.collects(self.iteration + 1):
            return "refinement"
        return f"growth, stopped at {self.rules.limit} Gaussians" if self.limited else "growth"

    def step(self) -> float:
        """One step of the optimiser on one view, and what the schedule adds to it.

        Returns:
            The loss.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        self.iteration += 1
        view = self._next_view()
        camera = self.scene.train.cameras[view]
        back = self._background_color()
        loss, offset, radii = self._loss(camera, self.images[view].to(self.device), back)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise Diverged(f"the loss is {value} at iteration {self.iteration}")
        if loss.requires_grad:
            self.optimiser.zero_grad()
            loss.backward()
            if offset is not None and offset.grad is not None:
                self._record(offset.grad, radii, camera)
            self.optimiser.rates["means"] = self._position_rate()
            self.optimiser.step()
        if self.schedule.grows(self.iteration):
            self._grow()
        if self.schedule.resets_opacity(self.iteration):
            self.optimiser.overwrite("logits", capped_logits(self.optimiser["logits"]))
        if self.iteration % _CHECK_EVERY == 0:
            self._check_finite()
        return value

    def _loss(
        self, camera: Camera, truth: torch.Tensor, back: RGB | torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor]:
        """Loss against a view (H, W, 4), screen offsets whose gradient densification reads, radii."""
        splats, offset = self._splat(self._colors(camera), camera)
        loss = self._image_loss(splats.features, splats.alpha, truth, back)
        return loss, offset, splats.radii

    def _splat(self, features: torch.Tensor, camera: Camera) -> tuple[Rasterised, torch.Tensor | None]:
        """Features splatted, and the screen offsets of :meth:`_loss`."""
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
            )
        except ValueError:
            self._check_finite()  # the usual reason; any other is a fault of the program
            raise
        return splats, offset

    def _image_loss(
        self, colors: torch.Tensor, alpha: torch.Tensor, truth: torch.Tensor, back: RGB | torch.Tensor
    ) -> torch.Tensor:
        """Loss of premultiplied colors over the background."""
        target = over(truth[..., :3], truth[..., 3], back)
        return photometric_loss(over(colors, alpha, back), target, float(self.options["ssim_weight"]))

    def _record(self, gradients: torch.Tensor, radii: torch.Tensor, camera: Camera) -> None:
        """Keep what densification wants to know of a view."""
        self.statistics.record(gradients, radii, camera.width, camera.height)

    def _colors(self, camera: Camera) -> torch.Tensor:
        now, degree = self.optimiser, self.schedule.degree(self.iteration)
        position = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        return spherical_harmonics(degree, now["means"], position, now["sh_dc"], now["sh_rest"])

    def _next_view(self) -> int:
        """Views come in random order, none twice before all were seen."""
        if not self.pending:
            self.pending = torch.randperm(len(self.scene.train), generator=self.generator).tolist()
        return self.pending.pop()

    def _background_color(self) -> RGB | torch.Tensor:
        return torch.rand(3, generator=self.generator) if self.background is None else self.background

    def _position_rate(self) -> float:
        first = float(self.options["position_lr"]) * self.scene.extent
        return self.schedule.decayed(self.iteration, first, POSITION_DECAY * first)

    def _grow(self, also: torch.Tensor | None = None) -> None:
        self._check_finite()
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
        self.statistics = GrowthStatistics.zeros(self.count, self.device)
        self.limited |= growth.limited

    def _check_finite(self) -> None:
        with torch.no_grad():
            for name in self.names:
                values = self.optimiser[name]
                # A logarithm may be finite and its exponential not.
                total = values.exp().sum() if name == "log_scales" else values.sum()
                if not math.isfinite(float(total)):
                    raise Diverged(f"{name} hold NaN or infinite values at iteration {self.iteration}")

    # ------------------------------------------------------------------ what comes out

    def model(self) -> GaussianModel:
        """The present state as a model of its own."""
        values = {name: self.optimiser[name].detach().clone() for name in PARAMETERS}
        background, degree = self.scene.train.background, self.schedule.sh_degree
        return GaussianModel([SceneGaussians(self.scene.name, background, degree, **values)])

    def checkpoint(self) -> Checkpoint:
        """All that :meth:`restore` needs to go on as if nothing had happened."""
        arrays = {f"optimiser/{name}": values.clone() for name, values in self.optimiser.state().items()}
        arrays |= {f"statistics/{name}": values.clone() for name, values in vars(self.statistics).items()}
        arrays["generator"] = self.generator.get_state()
        return Checkpoint(self.iteration, arrays, {"pending": list(self.pending), "limited": self.limited})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same fit."""
        arrays = {name: values.to(self.device) for name, values in checkpoint.arrays.items()}
        prefix = "optimiser/"
        self.optimiser.load_state(
            {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
        )
        self.statistics = GrowthStatistics(
            *(arrays[f"statistics/{name}"].clone() for name in ("gradients", "visits", "radii"))
        )
        self.generator.set_state(checkpoint.arrays["generator"].cpu())
        self.pending = [int(view) for view in checkpoint.scalars["pending"]]
        self.limited = bool(checkpoint.scalars["limited"])
        self.iteration = checkpoint.iteration
