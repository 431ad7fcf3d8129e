"""Base class of models of fields: rays are marched through all scenes at once."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.methods.interface import Edit
from econgs_bench.methods.shared.edits import opacity_factor
from econgs_bench.methods.shared.model import S, SceneSet


class FieldModel(SceneSet[S]):
    """A model of fields of density and color, of which opacity alone can be edited.

    A method's model adds ``drawn``, ``timings``, ``write`` (``write_size``, if it has several) and ``load``.
    """

    @abstractmethod
    def drawn(self, scenes: Sequence[S], camera: Camera, factors: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Premultiplied colors (H, W, 3) and alpha (H, W) of scenes, densities times their factors."""

    def picture(
        self, scenes: Sequence[S], camera: Camera, edits: Mapping[str, Edit]
    ) -> tuple[Tensor, Tensor]:
        """All fields of the scenes, marched at once."""
        factors = [opacity_factor(self.method, scene.name, edits.get(scene.name, Edit())) for scene in scenes]
        return self.drawn(scenes, camera, factors)
