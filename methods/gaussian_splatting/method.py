"""3DGS behind the interface of the harness."""

from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from econgs_bench.methods.gaussian_splatting.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class GaussianSplatting(TrainerMethod):
    """3D Gaussian splatting (Kerbl et al. 2023): every scene is a group of its own."""

    name, trainer, model = "3dgs", Trainer, GaussianModel
