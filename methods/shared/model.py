"""What models have in common: scenes under their names, and a clock."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Generic, TypeVar

import torch

from datasets.names import unknown
from methods.interface import Refused

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


def seconds(like: torch.Tensor) -> float:
    """The clock, once the tensor's device has done all it was asked to."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return time.perf_counter()
