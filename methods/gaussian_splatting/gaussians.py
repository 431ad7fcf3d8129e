"""Base class of trainers of Gaussians that are optimised as they are: 3DGS and its relatives, VEG."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.splat.rasterise import SplatImages, rasterise
from econgs_bench.methods.gaussian_splatting.schedule import Schedule
from econgs_bench.methods.shared.densification import DrawnView
from econgs_bench.methods.shared.splat_training import SplatTrainer


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnGaussians(DrawnView):
    """A view of Gaussians.

    Attributes:
        rows: (M,) numbers of those that the scene shows; None: all.
    """

    rows: torch.Tensor | None = None


class GaussianTrainer(SplatTrainer[DrawnGaussians]):
    """A fit of Gaussians, each of which has a row in every parameter; arguments as for its base class."""

    schedule: Schedule

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are optimised now."""
        return tuple(self.optimiser.parameters)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.optimiser["means"])

    def keep(self, kept: torch.Tensor) -> None:
        """Keep some Gaussians (mask) and remove the others."""
        self.optimiser.keep(kept, self.names)
        self.densification.reset()

    def pruning_logits(self) -> torch.Tensor:
        """(N,) logits of the opacities by which faint Gaussians are pruned."""
        return self.optimiser["logits"].detach()

    def splat(self, gaussians: Gaussians, camera: Camera) -> tuple[SplatImages, torch.Tensor | None]:
        """Gaussians drawn, colors of any width; and their offsets on the screen, while growth reads these."""
        offset = None
        if self.schedule.collects(self.iteration):
            offset = torch.zeros((len(gaussians.means), 2), device=self.device, requires_grad=True)
        try:
            splats = rasterise(
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                gaussians.opacities,
                gaussians.colors,
                camera,
                screen_offset=offset,
                low_pass=self.fit_low_pass,
            )
        except ValueError:
            self.check_finite()  # the usual reason; any other is a fault of the program
            raise
        return splats, offset
