"""HAC behind the interface of the harness."""

from methods.hac.model import HacModel
from methods.hac.training import Trainer
from methods.shared.method import TrainerMethod


class Hac(TrainerMethod):
    """Scaffold-GS whose anchors are entropy-coded with a context model (Chen et al. 2024)."""

    name, trainer, model = "hac", Trainer, HacModel
