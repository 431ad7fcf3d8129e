"""vq-3dgs behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods.interface import Model, SceneInput
from methods.shared.method import PerScene
from methods.vq_3dgs.model import VqModel, load_model
from methods.vq_3dgs.spec import VqOptions
from methods.vq_3dgs.training import VqTrainer


class VectorQuantised(PerScene[VqModel]):
    """3DGS whose attributes are words of codebooks."""

    name = "vq-3dgs"

    def trainer(
        self, scene: SceneInput, options: VqOptions, iterations: int, seed: int, device: str
    ) -> VqTrainer:
        """A fit at its beginning."""
        return VqTrainer(scene, options, iterations, seed, device)

    def load(self, folder: Path, device: str) -> VqModel:
        """Read a saved model."""
        return load_model(folder, device)

    def owns(self, model: Model) -> bool:
        """Whether it is a model of vq-3dgs."""
        return isinstance(model, VqModel)

    def joined(self, models: Sequence[VqModel]) -> VqModel:
        """Models as one."""
        stored = [scene for model in models for scene in model.stored]
        shown = [model.gaussians(name) for model in models for name in model.scenes]
        return VqModel(stored, shown, models[0].device)
