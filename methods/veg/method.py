"""VEG behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence

from econgs_bench.methods.interface import SceneInput
from econgs_bench.methods.shared.method import TrainerMethod
from econgs_bench.methods.veg.model import VegModel
from econgs_bench.methods.veg.spec import VegOptions
from econgs_bench.methods.veg.training import VegTrainer


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
