"""vq-3dgs behind the interface of the harness."""

from econgs_bench.methods.shared.method import TrainerMethod
from econgs_bench.methods.vq_3dgs.model import VqModel
from econgs_bench.methods.vq_3dgs.training import VqTrainer


class VectorQuantised(TrainerMethod):
    """3DGS whose Gaussians are vector-quantised after training, then fine-tuned."""

    name, trainer, model = "vq-3dgs", VqTrainer, VqModel
