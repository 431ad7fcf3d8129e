"""HAC++ behind the interface of the harness."""

from econgs_bench.methods.hac_plus.model import HacPlusModel
from econgs_bench.methods.hac_plus.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class HacPlus(TrainerMethod):
    """HAC with contexts within an anchor and masks that learn from bits (Chen et al. 2025)."""

    name, trainer, model = "hac-plus", Trainer, HacPlusModel
