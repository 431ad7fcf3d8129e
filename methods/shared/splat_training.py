"""Base class of trainers that splat Gaussians: filters, losses of a view, pruning by contribution."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol, TypeVar

from torch import Tensor

from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.losses import view_losses
from econgs_bench.econgs.splat import LowPass
from econgs_bench.methods.interface import SceneInput
from econgs_bench.methods.shared.densification import DrawnView
from econgs_bench.methods.shared.pruning import GaussiansInView, Prunable, PruningViews
from econgs_bench.methods.shared.schedule import Proportional
from econgs_bench.methods.shared.training import LossOptions, TrainingLoop, low_pass_of

V = TypeVar("V", bound=DrawnView)


class SplatOptions(LossOptions, Protocol):
    """Options that trainers of Gaussians read."""

    @property
    def ssim_weight(self) -> float:
        """Weight of 1 - SSIM against L1."""

    @property
    def prune_loss_db(self) -> float:
        """PSNR that pruning by contribution may lose [dB]; 0: nothing is pruned."""


class SplatTrainer(TrainingLoop[V]):
    """A fit of Gaussians, one view at a time; arguments as for its base class.

    Attributes:
        schedule: phases of the fit.
    """

    options: SplatOptions
    schedule: Proportional

    @property
    def low_pass(self) -> LowPass:
        """How models of this fit are drawn."""
        return low_pass_of(self.options, self.pixel)

    @property
    def fit_low_pass(self) -> LowPass:
        """How Gaussians are drawn in this iteration: at centres of pixels until half of the budget."""
        low_pass = self.low_pass
        late = 2 * self.iteration > self.schedule.iterations
        return low_pass if late else replace(low_pass, points=1)

    def begin_step(self) -> None:
        self.prune()

    def prune(self) -> bool:
        """Primitives that the pictures hardly show go, where the schedule says so; whether it does."""
        due = bool(self.options.prune_loss_db) and self.schedule.prunes_by_contribution(self.iteration)
        for one in self.prunable() if due else ():
            one.prune(self.options.prune_loss_db, self.low_pass, self.device)
        return due

    def prunable(self) -> Iterable[Prunable]:
        """The primitives that may go, each asked for after those before it went: none here."""
        return ()

    def pruning_views(
        self, source: SceneInput, images: Tensor, transparent: bool, gaussians: GaussiansInView
    ) -> PruningViews:
        """Views by which primitives are judged; arguments as they are named there."""
        return PruningViews(source.train, images, gaussians, asks_alpha=self.asks_alpha(transparent))

    def view_losses(
        self, colors: Tensor, alpha: Tensor, truth: Tensor, back: RGB | Tensor, transparent: bool = False
    ) -> dict[str, Tensor]:
        """Parts of the loss of a drawn view by name: "image", and "alpha" where alpha is a target.

        Args:
            colors: (H, W, 3) premultiplied.
            alpha: (H, W).
            truth: (H, W, 4) of the view.
            back: what both are composited on.
            transparent: as for :meth:`asks_alpha`.
        """
        asked = self.asks_alpha(transparent)
        weight = self.options.alpha_weight if asked else 0.0
        image, distance = view_losses(
            colors, alpha, truth, back, ssim_weight=self.options.ssim_weight, alpha_weight=weight
        )
        return {"image": image, "alpha": distance} if asked else {"image": image}
