"""The fit of 3DGS, unchanged: codecs come after it."""

from __future__ import annotations

from econgs_bench.methods.coded.model import CodedModel
from econgs_bench.methods.gaussian_splatting.spec import HarmonicsOptions
from econgs_bench.methods.gaussian_splatting.training import Trainer, plain_gaussians
from econgs_bench.methods.shared.training import TrainingState


class CodedTrainer(Trainer):
    """A fit of 3DGS; arguments as there."""

    @staticmethod
    def restored(state: TrainingState, options: HarmonicsOptions) -> CodedModel:
        """The Gaussians as they are until training ends, then as the default codec keeps them."""
        scene = plain_gaussians(state, options.sh_degree)
        if state.iteration < state.iterations:
            return CodedModel([scene], [scene])
        return CodedModel.of([scene])
