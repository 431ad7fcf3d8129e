"""ECoNGS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from econgs.grouping import chamfer_distances, cluster
from methods.econgs.memory import fit_to_memory
from methods.econgs.model import EcongsModel, load_model
from methods.econgs.spec import EcongsOptions
from methods.econgs.training import Trainer
from methods.interface import Budget, Checkpoint, Model, Monitor, Refused, SceneInput


class Econgs:
    """Neural editable Gaussians of anchors, learned jointly and entropy-coded (Tang and Wang)."""

    def partition(self, scenes: Sequence[SceneInput], options: EcongsOptions) -> list[list[SceneInput]]:
        """Scenes whose clouds are near each other share a group, as far as memory allows.

        Raises:
            Refused: a scene without an initial cloud, or one that does not fit into memory.
        """
        if not options.joint or len(scenes) < 2:
            return fit_to_memory([[scene] for scene in scenes], options)
        empty = [scene.name for scene in scenes if len(scene.cloud) == 0]
        if empty:
            raise Refused(f"no initial cloud to compare scene {empty[0]!r} by; set joint=false")
        distances = chamfer_distances([scene.cloud.points for scene in scenes], direction=options.chamfer)
        groups = cluster(distances, options.threshold, options.linkage)
        return fit_to_memory([[scenes[i] for i in group] for group in groups], options)

    def fit(
        self,
        group: Sequence[SceneInput],
        options: EcongsOptions,
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> EcongsModel:
        """Train one group; see :class:`methods.interface.Method`."""
        trainer = Trainer(group, options, budget.iterations, seed, device)
        if resume is not None:
            trainer.restore(resume)
        trainer.run(monitor)
        return trainer.model()

    def load(self, folder: Path, device: str) -> EcongsModel:
        """Read a saved model; see :func:`methods.econgs.model.load_model`."""
        return load_model(folder, device)

    def compose(self, models: Sequence[Model]) -> EcongsModel:
        """Hold the groups of all models."""
        others = [model for model in models if not isinstance(model, EcongsModel)]
        if others:
            raise Refused(f"econgs cannot compose with {type(others[0]).__name__}")
        own = [model for model in models if isinstance(model, EcongsModel)]
        return EcongsModel([group for model in own for group in model.groups])
