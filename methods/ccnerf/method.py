"""CCNeRF-CP behind the interface of the harness."""

from methods.ccnerf.model import CpModel
from methods.ccnerf.training import Trainer
from methods.shared.method import TrainerMethod


class CcNerf(TrainerMethod):
    """CCNeRF-CP (Tang et al. 2022): every scene is a group of its own."""

    name, trainer, model = "ccnerf", Trainer, CpModel
