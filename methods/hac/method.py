"""HAC behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from methods.hac.model import HacModel, load_model
from methods.hac.training import Trainer
from methods.interface import Budget, Checkpoint, Model, Monitor, OptionValue, Refused, SceneInput


class Hac:
    """Anchors coded with a hash-grid context (Chen et al. 2024): every scene is a group of its own."""

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
    ) -> Model:
        """Train one scene; see :class:`methods.interface.Method`."""
        if len(group) != 1:
            raise Refused(f"hac trains each scene on its own, not {len(group)} together")
        trainer = Trainer(group[0], options, budget.iterations, seed, device)
        if resume is not None:
            trainer.restore(resume)
        trainer.run(monitor)
        return trainer.model()

    def load(self, folder: Path, device: str) -> HacModel:
        """Read a saved model; see :func:`methods.hac.model.load_model`."""
        return load_model(folder, device)

    def compose(self, models: Sequence[Model]) -> HacModel:
        """Hold the anchors of all models; their Gaussians are concatenated and sorted once when rendered."""
        own = [model for model in models if isinstance(model, HacModel)]
        if len(own) != len(models):
            raise Refused("hac composes with models of its own only")
        return HacModel([group for model in own for group in model.groups], own[0].device)
