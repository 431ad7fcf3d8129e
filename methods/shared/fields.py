"""Base class of models of fields: rays are marched through all scenes at once."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

from torch import Tensor

from datasets.camera import Camera
from datasets.scene import RGB
from econgs.splat.composite import over
from methods.interface import Edit, edits_by_scene
from methods.shared.edits import opacity_factor
from methods.shared.model import S, SceneSet


class FieldModel(SceneSet[S]):
    """A model of fields of density and color, of which opacity alone can be edited.

    A method's model adds ``drawn``, ``timings``, ``write`` (``write_size``, if it has several) and ``load``.
    """

    @abstractmethod
    def drawn(self, scenes: Sequence[S], camera: Camera, factors: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Premultiplied colors (H, W, 3) and alpha (H, W) of scenes, densities times their factors."""

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Render scenes together; see :class:`methods.interface.Model`."""
        subset = self.chosen(scenes)
        back = subset[0].background if background is None else background
        edits = edits_by_scene(edit, [scene.name for scene in subset])
        factors = [opacity_factor(self.method, scene.name, edits.get(scene.name, Edit())) for scene in subset]
        colors, alpha = self.drawn(subset, camera, factors)
        return over(colors, alpha, back).clamp_(0.0, 1.0), alpha.clamp(0.0, 1.0)
