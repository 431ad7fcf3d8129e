"""iVR-GS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods.interface import Model, SceneInput
from methods.ivr_gs.model import IvrModel, load_model
from methods.ivr_gs.spec import IvrOptions
from methods.ivr_gs.training import IvrTrainer
from methods.shared.method import PerScene


class IvrGs(PerScene[IvrModel]):
    """Editable Gaussians shaded by Blinn-Phong (Tang et al. 2025)."""

    name = "ivr-gs"

    def trainer(
        self, scene: SceneInput, options: IvrOptions, iterations: int, seed: int, device: str
    ) -> IvrTrainer:
        """A fit at its beginning."""
        return IvrTrainer(scene, options, iterations, seed, device)

    def load(self, folder: Path, device: str) -> IvrModel:
        """Read a saved model."""
        return load_model(folder, device)

    def owns(self, model: Model) -> bool:
        """Whether it is a model of iVR-GS."""
        return isinstance(model, IvrModel)

    def joined(self, models: Sequence[IvrModel]) -> IvrModel:
        """Models as one."""
        shown = [model.gaussians(name) for model in models for name in model.scenes]
        whole = all(model.stored is not None for model in models)
        stored = [one for model in models for one in model.stored or ()]
        return IvrModel(shown, stored if whole else None)
