"""Base class of methods: a trainer fits, a model loads and joins."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from econgs_bench.methods.interface import Budget, Checkpoint, Model, Monitor, Refused, SceneInput
from econgs_bench.methods.shared.model import SceneSet
from econgs_bench.methods.shared.rendering import Rendering
from econgs_bench.methods.shared.training import TrainingLoop
from econgs_bench.methods.shared.units import in_units, units_of


class TrainerMethod:
    """A :class:`.methods.interface.Method` whose groups are single scenes, unless it is joint.

    Attributes:
        name: the method's name, for messages.
        trainer: class that trains a scene (a group, if joint); its arguments are the scene, options,
            iterations, seed and device.
        model: class of its models.
        joint: whether several scenes make a group; such a method has a ``partition`` of its own.
    """

    name: ClassVar[str]
    trainer: ClassVar[type[TrainingLoop[Any]]]
    model: ClassVar[type[SceneSet[Any]]]
    joint: ClassVar[bool] = False

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
    ) -> Any:
        """Train one group, in units that suit its extent; see :class:`.methods.interface.Method`."""
        units = units_of(group)
        group = [in_units(scene, 1.0 / units) for scene in group]
        if len(group) != 1 and not self.joint:
            raise Refused(f"{self.name} trains each scene on its own, not {len(group)} together")
        subject: Any = group if self.joint else group[0]
        make: Any = self.trainer
        trainer: TrainingLoop[Any] = make(subject, options, budget.iterations, seed, device)
        if resume is not None:
            trainer.resume(resume)
        trainer.run(monitor, units)
        return trainer.model_in_scene_units()

    def restore(self, checkpoint: Checkpoint, options: Any, device: str) -> Any:
        """The model of a checkpoint, of a finished fit or an earlier one."""
        return self.trainer.scene_model(checkpoint, options, device)

    def load(self, folder: Path, device: str) -> Any:
        """Read a saved model."""
        return self.model.load(folder, device).drawn_by(Rendering.read(folder))

    def compose(self, models: Sequence[Model]) -> Any:
        """One model of the scenes of all; they are concatenated and sorted once when rendered."""
        if not models or not all(isinstance(model, self.model) for model in models):
            raise Refused(f"{self.name} composes with models of its own only")
        renderings = {model.rendering for model in models if isinstance(model, SceneSet)}
        if len(renderings) > 1:
            raise Refused(f"{self.name} composes models of like scene units and low-pass filter only")
        return self.model.join(models).drawn_by(renderings.pop())
