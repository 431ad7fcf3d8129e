"""ECoNGS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence

from econgs.grouping import chamfer_distances, cluster
from methods.econgs.memory import fit_to_memory
from methods.econgs.model import EcongsModel
from methods.econgs.spec import EcongsOptions
from methods.econgs.training import Trainer
from methods.interface import Refused, SceneInput
from methods.shared.method import TrainerMethod
from methods.shared.units import units_of


class Econgs(TrainerMethod):
    """Neural editable Gaussians of anchors, learned jointly and entropy-coded (Tang and Wang)."""

    name, trainer, model = "econgs", Trainer, EcongsModel
    joint = True

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
        clouds = [scene.cloud.points for scene in scenes]
        distances = chamfer_distances(clouds, direction=options.chamfer, sample=options.chamfer_points)
        groups = cluster(distances, units_of(scenes) * options.threshold, options.linkage)
        return fit_to_memory([[scenes[i] for i in group] for group in groups], options)
