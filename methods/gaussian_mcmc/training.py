"""Training 3DGS-MCMC: the loop of 3DGS with a number of Gaussians that has a cap, and noise on positions."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.methods.gaussian_mcmc.chain import noise, shared_opacity
from econgs_bench.methods.gaussian_mcmc.schedule import Schedule
from econgs_bench.methods.gaussian_mcmc.spec import McmcOptions
from econgs_bench.methods.gaussian_splatting.gaussians import DrawnGaussians
from econgs_bench.methods.gaussian_splatting.initialise import first_gaussians, first_points
from econgs_bench.methods.gaussian_splatting.training import HarmonicsTrainer
from econgs_bench.methods.shared.densification import Densification

START_SCALE = 0.1
"""First scales, in distances to neighbours."""
GROWTH = 0.05
"""Gaussians that an event adds, as a share of those there are."""
PUBLISHED_EXTENT = 4.43
"""Extent of the synthetic scenes for which noise and weights were published."""


class Relocation(Densification["McmcTrainer", DrawnGaussians]):
    """Moves dead Gaussians onto living ones, adds some up to the cap, and moves positions by noise.

    Nothing is cloned, split, pruned or reset. Lengths count in units in which the scene's extent is the
    published one: noise and weights mean the same in a scene of any size.
    """

    def before_backward(self) -> dict[str, Tensor]:
        """Regularisers of opacities and scales."""
        options, losses = self.fit.options, {}
        if weight := options.opacity_weight:
            losses["opacity"] = weight * self.fit.optimiser["logits"].sigmoid().mean()
        if weight := options.scale_weight * PUBLISHED_EXTENT / self.fit.scene.extent:
            losses["scale"] = weight * self.fit.optimiser["log_scales"].exp().mean()
        return losses

    @torch.no_grad()
    def after_step(self, drawn: DrawnGaussians) -> None:
        if self.fit.schedule.grows(self.fit.iteration):
            self.fit.check_finite()
            self.relocate()
            self.add()
        self.move()

    def stage(self) -> str:
        if self.fit.iteration + 1 >= self.fit.schedule.growth_stop:
            return "refinement"
        return "growth" if self.fit.count < self.fit.options.cap else "relocation"

    def relocate(self) -> None:
        """Move the dead onto living Gaussians, drawn by opacity."""
        opacities = self.fit.optimiser["logits"].sigmoid()
        dead = opacities <= self.fit.options.dead_opacity
        places = dead.nonzero()[:, 0]
        sources = self._drawn(torch.where(dead, 0.0, opacities), len(places))
        if len(sources):
            self._share(sources)
            for name in self.fit.names:
                self.fit.optimiser.write(name, places, self.fit.optimiser[name][sources])

    def add(self) -> None:
        """Add copies of Gaussians, drawn by opacity, up to the cap."""
        room = self.fit.options.cap - self.fit.count
        count = min(room, max(1, int(GROWTH * self.fit.count)))
        sources = self._drawn(self.fit.optimiser["logits"].sigmoid(), count)
        if len(sources):
            self._share(sources)
            self.fit.optimiser.append({name: self.fit.optimiser[name][sources] for name in self.fit.names})

    def _drawn(self, chances: Tensor, count: int) -> Tensor:
        """``count`` indices, with replacement; none where all chances are zero."""
        if count == 0 or not float(chances.sum()) > 0.0:
            return torch.zeros(0, dtype=torch.int64, device=self.fit.device)
        drawn = torch.multinomial(chances.cpu(), count, replacement=True, generator=self.fit.generator)
        return drawn.to(self.fit.device)

    def _share(self, sources: Tensor) -> None:
        """Give each source the opacity and scales of its copies, one for each time that it was drawn."""
        rows, drawn = sources.unique(return_counts=True)
        logits, log_scales = self.fit.optimiser["logits"][rows], self.fit.optimiser["log_scales"][rows]
        opacity, factor = shared_opacity(logits.sigmoid(), drawn + 1, self.fit.options.dead_opacity)
        self.fit.optimiser.write("logits", rows, opacity.logit().to(logits))
        self.fit.optimiser.write("log_scales", rows, log_scales + factor.log()[:, None].to(log_scales))
        self.fit.optimiser.forget(rows, self.fit.names)

    def move(self) -> None:
        """Noise on the positions of transparent Gaussians."""
        now, options = self.fit.optimiser, self.fit.options
        if not options.noise_rate:
            return
        # Covariance is a length squared, a learning rate of positions a length: two of three are divided out.
        scale = (PUBLISHED_EXTENT / self.fit.scene.extent) ** 2
        step = noise(now["log_scales"], now["quats"], now["logits"], options.dead_opacity, self.fit.generator)
        now["means"].add_(step, alpha=options.noise_rate * now.learning_rates["means"] * scale)


class McmcTrainer(HarmonicsTrainer):
    """A fit whose number of Gaussians has a cap; arguments as for 3DGS.

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

    def _densification(self) -> Relocation:
        return Relocation(self)
