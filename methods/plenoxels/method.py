"""Plenoxels behind the interface of the harness."""

from econgs_bench.methods.plenoxels.model import VoxelModel
from econgs_bench.methods.plenoxels.training import Trainer
from econgs_bench.methods.shared.method import TrainerMethod


class Plenoxels(TrainerMethod):
    """Plenoxels (Fridovich-Keil, Yu et al. 2022): every scene is a group of its own."""

    name, trainer, model = "plenoxels", Trainer, VoxelModel
