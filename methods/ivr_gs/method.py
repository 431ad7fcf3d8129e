"""iVR-GS behind the interface of the harness."""

from econgs_bench.methods.ivr_gs.model import IvrModel
from econgs_bench.methods.ivr_gs.training import IvrTrainer
from econgs_bench.methods.shared.method import TrainerMethod


class IvrGs(TrainerMethod):
    """Editable Gaussians with Blinn-Phong attributes (Tang, Yao and Wang 2025)."""

    name, trainer, model = "ivr-gs", IvrTrainer, IvrModel
