"""CCNeRF-CP behind the interface of the harness."""

from econgs_bench.methods.ccnerf.model import CpModel
from econgs_bench.methods.ccnerf.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class CcNerf(TrainerMethod):
    """CCNeRF-CP (Tang et al. 2022): every scene is a group of its own."""

    name, trainer, model = "ccnerf", Trainer, CpModel
