"""Plenoxels behind the interface of the harness."""

from methods.plenoxels.model import VoxelModel
from methods.plenoxels.training import Trainer
from methods.shared.method import TrainerMethod


class Plenoxels(TrainerMethod):
    """Plenoxels (Fridovich-Keil, Yu et al. 2022): every scene is a group of its own."""

    name, trainer, model = "plenoxels", Trainer, VoxelModel
