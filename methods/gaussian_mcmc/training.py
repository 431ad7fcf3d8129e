"""Training 3DGS-MCMC: the loop of 3DGS with a number of Gaussians that has a cap, and noise on positions."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB
from econgs_bench.methods.gaussian_mcmc.chain import noise, shared_opacity
from econgs_bench.methods.gaussian_mcmc.schedule import Schedule
from econgs_bench.methods.gaussian_mcmc.spec import McmcOptions
from econgs_bench.methods.gaussian_splatting.initialise import first_gaussians, first_points
from econgs_bench.methods.gaussian_splatting.training import HarmonicsTrainer

START_SCALE = 0.1
"""First scales, in distances to neighbours."""
GROWTH = 0.05
"""Gaussians that an event adds, as a share of those there are."""
PUBLISHED_EXTENT = 4.43
"""Extent of the synthetic scenes for which noise and weights were published."""


class McmcTrainer(HarmonicsTrainer):
    """A fit whose dead Gaussians are moved onto living ones; arguments as for 3DGS.

    Nothing is cloned, split, pruned or reset. Lengths count in units in which the scene's extent is the
    published one: noise and weights mean the same in a scene of any size.

    Raises:
        Refused: no views, or no initial points.
    """

    options: McmcOptions
    schedule: Schedule

    def _schedule(self, iterations: int) -> Schedule:
        return Schedule(iterations, sh_degree=self.options.sh_degree, decay=self.options.decay)

    def _first(self) -> dict[str, Tensor]:
        """At random points of the cloud, where it holds more than the cap."""
        points, colors = first_points(self.scene, self.options, self.generator)
        if len(points) > self.options.cap:
            some = torch.randperm(len(points), generator=self.generator)[: self.options.cap].sort().values
            points, colors = points[some], colors[some]
        scale = START_SCALE * self.options.start_scale
        opacity = self.options.start_opacity
        return first_gaussians(points, colors, self.scene.extent, scale=scale, opacity=opacity)

    def stage(self) -> str:
        if self.iteration + 1 >= self.schedule.growth_stop:
            return "refinement"
        return "growth" if self.count < self.options.cap else "relocation"

    def _losses(
        self, camera: Camera, truth: Tensor, back: RGB | Tensor
    ) -> tuple[dict[str, Tensor], Tensor | None, Tensor]:
        losses, offset, radii = super()._losses(camera, truth, back)
        if weight := self.options.opacity_weight:
            losses["opacity"] = weight * self.optimiser["logits"].sigmoid().mean()
        if weight := self.options.scale_weight * PUBLISHED_EXTENT / self.scene.extent:
            losses["scale"] = weight * self.optimiser["log_scales"].exp().mean()
        return losses, offset, radii

    @torch.no_grad()
    def _control(self) -> None:
        if self.schedule.grows(self.iteration):
            self.check_finite()
            self._relocate()
            self._add()
        self._move()

    def _relocate(self) -> None:
        """Move the dead onto living Gaussians, drawn by opacity."""
        opacities = self.optimiser["logits"].sigmoid()
        dead = opacities <= self.options.dead_opacity
        places = dead.nonzero()[:, 0]
        sources = self._drawn(torch.where(dead, 0.0, opacities), len(places))
        if len(sources):
            self._share(sources)
            for name in self.names:
                self.optimiser.write(name, places, self.optimiser[name][sources])

    def _add(self) -> None:
        """Add copies of Gaussians, drawn by opacity, up to the cap."""
        room = self.options.cap - self.count
        count = min(room, max(1, int(GROWTH * self.count)))
        sources = self._drawn(self.optimiser["logits"].sigmoid(), count)
        if len(sources):
            self._share(sources)
            self.optimiser.append({name: self.optimiser[name][sources] for name in self.names})

    def _drawn(self, chances: Tensor, count: int) -> Tensor:
        """``count`` indices, with replacement; none where all chances are zero."""
        if count == 0 or not float(chances.sum()) > 0.0:
            return torch.zeros(0, dtype=torch.int64, device=self.device)
        drawn = torch.multinomial(chances.cpu(), count, replacement=True, generator=self.generator)
        return drawn.to(self.device)

    def _share(self, sources: Tensor) -> None:
        """Give each source the opacity and scales of its copies, one for each time that it was drawn."""
        rows, drawn = sources.unique(return_counts=True)
        logits, log_scales = self.optimiser["logits"][rows], self.optimiser["log_scales"][rows]
        opacity, factor = shared_opacity(logits.sigmoid(), drawn + 1, self.options.dead_opacity)
        self.optimiser.write("logits", rows, opacity.logit().to(logits))
        self.optimiser.write("log_scales", rows, log_scales + factor.log()[:, None].to(log_scales))
        self.optimiser.forget(rows, self.names)

    def _move(self) -> None:
        """Noise on the positions of transparent Gaussians."""
        if not self.options.noise_rate:
            return
        now = self.optimiser
        # Covariance is a length squared and the rate of positions a length: two of the three are divided out.
        rate = self.options.noise_rate * now.rates["means"] * (PUBLISHED_EXTENT / self.scene.extent) ** 2
        step = noise(
            now["log_scales"], now["quats"], now["logits"], self.options.dead_opacity, self.generator
        )
        now["means"].add_(step, alpha=rate)
