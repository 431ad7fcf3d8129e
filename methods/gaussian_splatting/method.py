"""3DGS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from methods.gaussian_splatting.model import GaussianModel, load_model
from methods.gaussian_splatting.training import Trainer
from methods.interface import Budget, Checkpoint, Model, Monitor, OptionValue, Refused, SceneInput


class GaussianSplatting:
    """3D Gaussian splatting (Kerbl et al. 2023): every scene is a group of its own."""

    def partition(
        self, scenes: Sequence[SceneInput], options: Mapping[str, OptionValue]
    ) -> list[list[SceneInput]]:
        """One group per scene."""
        return [[scene] for scene in scenes]

    def fit(
        self,
        group: Sequence[SceneInput],
        options: Mapping[str, OptionValue],
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> GaussianModel:
        """Train one scene; see :class:`methods.interface.Method`."""
        if len(group) != 1:
            raise Refused(f"3dgs trains each scene on its own, not {len(group)} together")
        trainer = Trainer(group[0], options, budget.iterations, seed, device)
        if resume is not None:
            trainer.restore(resume)
        trainer.run(monitor)
        return trainer.model()

    def load(self, folder: Path, device: str) -> GaussianModel:
        """Read a saved model; see :func:`methods.gaussian_splatting.model.load_model`."""
        return load_model(folder, device)

    def compose(self, models: Sequence[Model]) -> GaussianModel:
        """Hold the Gaussians of all models; they are concatenated and sorted once when rendered."""
        others = [model for model in models if not isinstance(model, GaussianModel)]
        if others:
            raise Refused(f"3dgs cannot compose with {type(others[0]).__name__}")
        own = [model for model in models if isinstance(model, GaussianModel)]
        return GaussianModel([model.gaussians(name) for model in own for name in model.scenes])
