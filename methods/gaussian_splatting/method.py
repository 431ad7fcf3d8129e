"""3DGS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods.gaussian_splatting.model import GaussianModel, load_model
from methods.gaussian_splatting.spec import GaussianOptions
from methods.gaussian_splatting.training import Trainer
from methods.interface import Model, SceneInput
from methods.shared.method import PerScene


class GaussianSplatting(PerScene[GaussianModel]):
    """3D Gaussian splatting (Kerbl et al. 2023): every scene is a group of its own."""

    name = "3dgs"

    def trainer(
        self, scene: SceneInput, options: GaussianOptions, iterations: int, seed: int, device: str
    ) -> Trainer:
        """A fit at its beginning."""
        return Trainer(scene, options, iterations, seed, device)

    def load(self, folder: Path, device: str) -> GaussianModel:
        """Read a saved model; see :func:`methods.gaussian_splatting.model.load_model`."""
        return load_model(folder, device)

    def owns(self, model: Model) -> bool:
        """Whether it is a model of 3DGS."""
        return isinstance(model, GaussianModel)

    def joined(self, models: Sequence[GaussianModel]) -> GaussianModel:
        """Their Gaussians; they are concatenated and sorted once when rendered."""
        return GaussianModel([model.gaussians(name) for model in models for name in model.scenes])
