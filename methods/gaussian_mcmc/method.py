"""3DGS-MCMC behind the interface of the harness."""

from econgs_bench.methods.gaussian_mcmc.training import McmcTrainer
from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from econgs_bench.methods.shared.method import TrainerMethod


class GaussianMcmc(TrainerMethod):
    """3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024); models are those of 3DGS."""

    name, trainer, model = "3dgs-mcmc", McmcTrainer, GaussianModel
