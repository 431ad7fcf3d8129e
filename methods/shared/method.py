"""What methods have in common that fit every scene on its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from methods.interface import Budget, Checkpoint, Model, Monitor, Refused, SceneInput

M = TypeVar("M", bound=Model)


class SceneTrainer(Protocol):
    """The fit of one scene."""

    def restore(self, checkpoint: Checkpoint) -> None: ...

    def run(self, monitor: Monitor) -> None: ...

    def model(self) -> Any: ...


class PerScene(ABC, Generic[M]):
    """A :class:`methods.interface.Method` whose groups are single scenes and that composes its own models.

    Attributes:
        name: of the method, for messages.
    """

    name: str

    @abstractmethod
    def trainer(
        self, scene: SceneInput, options: Any, iterations: int, seed: int, device: str
    ) -> SceneTrainer:
        """A fit at its beginning."""

    @abstractmethod
    def load(self, folder: Path, device: str) -> M:
        """Read a saved model."""

    @abstractmethod
    def joined(self, models: Sequence[M]) -> M:
        """Models of this method as one."""

    @abstractmethod
    def owns(self, model: Model) -> bool:
        """Whether a model is of this method."""

    def partition(self, scenes: Sequence[SceneInput], options: Any) -> list[list[SceneInput]]:
        """One group per scene."""
        return [[scene] for scene in scenes]

    def fit(
        self,
        group: Sequence[SceneInput],
        options: Any,
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> M:
        """Train one scene; see :class:`methods.interface.Method`."""
        if len(group) != 1:
            raise Refused(f"{self.name} trains each scene on its own, not {len(group)} together")
        trainer = self.trainer(group[0], options, budget.iterations, seed, device)
        if resume is not None:
            trainer.restore(resume)
        trainer.run(monitor)
        model: M = trainer.model()
        return model

    def compose(self, models: Sequence[Model]) -> M:
        """Hold the primitives of all models; they are concatenated and sorted once when rendered."""
        own: list[Any] = list(models)
        if not own or not all(self.owns(model) for model in own):
            raise Refused(f"{self.name} composes with models of its own only")
        return self.joined(own)
