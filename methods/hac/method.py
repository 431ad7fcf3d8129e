"""HAC behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods.hac.model import HacModel, load_model
from methods.hac.spec import HacOptions
from methods.hac.training import Trainer
from methods.interface import Model, SceneInput
from methods.shared.method import PerScene


class Hac(PerScene[HacModel]):
    """Anchors coded with a hash-grid context (Chen et al. 2024): every scene is a group of its own."""

    name = "hac"

    def trainer(
        self, scene: SceneInput, options: HacOptions, iterations: int, seed: int, device: str
    ) -> Trainer:
        """A fit at its beginning."""
        return Trainer(scene, options, iterations, seed, device)

    def load(self, folder: Path, device: str) -> HacModel:
        """Read a saved model; see :func:`methods.hac.model.load_model`."""
        return load_model(folder, device)

    def joined(self, models: Sequence[HacModel]) -> HacModel:
        """Their anchors; Gaussians are concatenated and sorted once when rendered."""
        return HacModel([group for model in models for group in model.groups], models[0].device)

    def owns(self, model: Model) -> bool:
        """Whether a model is of this method."""
        return isinstance(model, HacModel)
