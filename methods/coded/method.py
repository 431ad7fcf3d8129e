"""3dgs-coded behind the interface of the harness."""

from econgs_bench.methods.coded.model import CodedModel
from econgs_bench.methods.coded.training import CodedTrainer
from econgs_bench.methods.shared.method import TrainerMethod


class CodedSplatting(TrainerMethod):
    """3DGS as it is trained, saved by one of several codecs."""

    name, trainer, model = "3dgs-coded", CodedTrainer, CodedModel
