"""HAC behind the interface of the harness."""

from econgs_bench.methods.hac.model import HacModel
from econgs_bench.methods.hac.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class Hac(TrainerMethod):
    """Scaffold-GS whose anchors are entropy-coded with a context model (Chen et al. 2024)."""

    name, trainer, model = "hac", Trainer, HacModel
