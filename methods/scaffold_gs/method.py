"""Scaffold-GS behind the interface of the harness."""

from econgs_bench.methods.scaffold_gs.model import ScaffoldModel
from econgs_bench.methods.scaffold_gs.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class ScaffoldGS(TrainerMethod):
    """Anchors that decode to Gaussians by the view (Lu et al. 2024)."""

    name, trainer, model = "scaffold-gs", Trainer, ScaffoldModel
