"""ECoNGS behind the interface of the harness."""

from __future__ import annotations

from collections.abc import Sequence

from econgs_bench.econgs.grouping import chamfer_distances, cluster
from econgs_bench.methods.econgs.memory import fit_to_memory
from econgs_bench.methods.econgs.model import EcongsModel
from econgs_bench.methods.econgs.spec import EcongsOptions
from econgs_bench.methods.econgs.training import Trainer
from econgs_bench.methods.interface import Refused, SceneInput
from econgs_bench.methods.shared.method import TrainerMethod
from econgs_bench.methods.shared.units import units_of


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
