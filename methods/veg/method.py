"""VEG behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence

from methods.interface import SceneInput
from methods.shared.method import TrainerMethod
from methods.veg.model import VegModel
from methods.veg.spec import VegOptions
from methods.veg.training import VegTrainer


class Veg(TrainerMethod):
    """Gaussians that carry a scalar, one set for all transfer functions (Dyken et al. 2025)."""

    name, trainer, model = "veg", VegTrainer, VegModel
    joint = True

    def partition(self, scenes: Sequence[SceneInput], options: VegOptions) -> list[list[SceneInput]]:
        """Scenes that show one variable through transfer functions share a group.

        Any other scene is alone: its fit is refused, by its name.
        """
        groups: dict[str, list[SceneInput]] = {}
        for scene in scenes:
            key = f"variable {scene.scene.variable}" if scene.scene.transfer else f"scene {scene.name}"
            groups.setdefault(key, []).append(scene)
        return list(groups.values())
