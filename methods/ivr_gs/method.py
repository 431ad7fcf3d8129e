"""iVR-GS behind the interface of the harness."""

from methods.ivr_gs.model import IvrModel
from methods.ivr_gs.training import IvrTrainer
from methods.shared.method import TrainerMethod


class IvrGs(TrainerMethod):
    """Editable Gaussians with Blinn-Phong attributes (Tang, Yao and Wang 2025)."""

    name, trainer, model = "ivr-gs", IvrTrainer, IvrModel
