"""What a step draws, and the strategies that decide on the number of primitives by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from torch import Tensor

from econgs_bench.datasets.camera import Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawn:
    """What a step has drawn.

    Attributes:
        losses: parts of the loss by name, with their weights; their sum is minimised.
        figures: further numbers to report.
        scene: place of the drawn scene in the group.
    """

    losses: Mapping[str, Tensor | float]
    figures: Mapping[str, Tensor] = field(default_factory=dict)
    scene: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnView(Drawn):
    """A splatted view.

    Attributes:
        camera: camera of the view.
        offset: (M, 2) offsets of the Gaussians on the screen, whose gradients growth reads, if it does.
        radii: (M,) pixels, 0 where a Gaussian has none.
    """

    camera: Camera
    offset: Tensor | None
    radii: Tensor


F = TypeVar("F")
D = TypeVar("D", bound=Drawn)


class Densification(Generic[F, D]):
    """A strategy that adds, moves and removes primitives: hooks of a step (:mod:`.methods.shared.training`).

    This one leaves their number as it is.

    Args:
        fit: the fit, whose optimiser holds the primitives.

    Attributes:
        limited: growth has met its limit.
    """

    def __init__(self, fit: F) -> None:
        self.fit, self.limited = fit, False
        self.reset()

    def reset(self) -> None:
        """Begin statistics anew, with a row for each primitive there is now."""

    def before_backward(self) -> Mapping[str, Tensor]:
        """Further parts of the loss."""
        return {}

    def after_backward(self, drawn: D) -> None:
        """Take statistics of the gradients."""

    def after_step(self, drawn: D) -> None:
        """Change the primitives, after the optimiser's step."""

    def stage(self) -> str:
        """Name of the stage that the next iteration belongs to, for people."""
        return ""

    def state(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint beside the optimiser's state."""
        return {}

    def load_state(self, arrays: Mapping[str, Tensor]) -> None:
        """Continue from a checkpoint that holds :meth:`state`."""
