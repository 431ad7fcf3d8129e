"""Scaffold-GS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods.interface import Model, SceneInput
from methods.scaffold_gs.model import ScaffoldModel, load_model
from methods.scaffold_gs.spec import ScaffoldOptions
from methods.scaffold_gs.training import Trainer
from methods.shared.method import PerScene


class ScaffoldGS(PerScene[ScaffoldModel]):
    """Gaussians decoded from anchors (Lu et al. 2024): every scene is a group of its own."""

    name = "scaffold-gs"

    def trainer(
        self, scene: SceneInput, options: ScaffoldOptions, iterations: int, seed: int, device: str
    ) -> Trainer:
        """A fit at its beginning."""
        return Trainer(scene, options, iterations, seed, device)

    def load(self, folder: Path, device: str) -> ScaffoldModel:
        """Read a saved model; see :func:`methods.scaffold_gs.model.load_model`."""
        return load_model(folder, device)

    def joined(self, models: Sequence[ScaffoldModel]) -> ScaffoldModel:
        """Their anchors; Gaussians are concatenated and sorted once when rendered."""
        return ScaffoldModel([scene for model in models for scene in model.stored], models[0].device)

    def owns(self, model: Model) -> bool:
        """Whether a model is of this method."""
        return isinstance(model, ScaffoldModel)
