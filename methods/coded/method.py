"""3dgs-coded behind the interface of the harness."""

from methods.coded.model import CodedModel
from methods.coded.training import CodedTrainer
from methods.shared.method import TrainerMethod


class CodedSplatting(TrainerMethod):
    """3DGS as it is trained, saved by one of several codecs."""

    name, trainer, model = "3dgs-coded", CodedTrainer, CodedModel
