"""Scaffold-GS behind the interface of the harness."""

from methods.scaffold_gs.model import ScaffoldModel
from methods.scaffold_gs.training import Trainer
from methods.shared.method import TrainerMethod


class ScaffoldGS(TrainerMethod):
    """Anchors that decode to Gaussians by the view (Lu et al. 2024)."""

    name, trainer, model = "scaffold-gs", Trainer, ScaffoldModel
