"""What models have in common that hold scenes by name."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Generic, TypeVar

import torch

from datasets.names import unknown
from methods.interface import Edit, Refused, edits_by_scene

S = TypeVar("S")


class ByScene(Generic[S]):
    """Scenes under their names.

    Args:
        scenes: names, each once, with what is held of the scene.

    Raises:
        Refused: two scenes have the same name.
    """

    def __init__(self, scenes: Iterable[tuple[str, S]]) -> None:
        pairs = list(scenes)
        self._scenes = dict(pairs)
        if len(self._scenes) != len(pairs):
            raise Refused("two of the scenes to compose have the same name")

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes it holds."""
        return tuple(self._scenes)

    def _find(self, scene: str) -> S:
        """What is held of a scene.

        Raises:
            UnknownName: it does not hold that scene.
        """
        if scene not in self._scenes:
            raise unknown("scene", scene, self._scenes, of="this model")
        return self._scenes[scene]


def opacity_factors(
    method: str, names: Sequence[str], edit: Mapping[str, Edit] | None
) -> dict[str, float | None]:
    """Factors of opacity by scene, of a method that edits nothing else; None where it stays.

    Raises:
        Refused: an edit of anything else, a scene that is not rendered, a factor out of range.
    """
    factors = {}
    for name, wanted in edits_by_scene(edit, names).items():
        refused = [k for k, v in vars(wanted).items() if v is not None and k != "opacity"]
        if refused:
            raise Refused(f"{method} cannot edit {', '.join(refused)} of scene {name!r}: only opacity")
        factor = wanted.opacity
        if factor is not None and not (math.isfinite(factor) and factor >= 0.0):
            raise Refused(f"opacity factor {factor} of scene {name!r} is not a finite number >= 0")
        factors[name] = factor
    return factors


def seconds(like: torch.Tensor) -> float:
    """The clock, once the tensor's device has done all it was asked to."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return time.perf_counter()
