"""The method itself: training, rendering, and the file of a scene."""

from __future__ import annotations

import json
from dataclasses import dataclass
from urllib.parse import quote

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors

from datasets.errors import DataError
from econgs.anchors.gaussians import Gaussians, draw
from econgs.losses import photometric_loss
from econgs.optim import Adam
from econgs.splat.composite import over, scale_depth
from methods.interface import Refused
from methods.shared.edits import opacity_factor
from methods.shared.files import saved_files
from methods.shared.method import TrainerMethod
from methods.shared.model import SceneModel
from methods.shared.training import TrainingLoop

FORMAT = "toy-blobs 1"
SUFFIX = ".blobs"


def blobs(positions, values, size, opacity=1.0):
    """Round Gaussians at positions [N, 3] with values [N, 4] in [0, 1]: color and opacity."""
    quats = torch.eye(4)[:1].to(positions).repeat(len(positions), 1)
    scales = torch.full_like(positions, size)
    return Gaussians(positions, quats, scales, scale_depth(values[:, 3], opacity), values[:, :3])


class Trainer(TrainingLoop):
    """Adam on the color and opacity of every point."""

    def __init__(self, scene, options, iterations, seed, device):
        super().__init__([scene], iterations, seed, device)
        if len(scene.cloud) == 0:
            raise Refused(f"scene {scene.name!r} has no cloud")
        self.train, self.options = scene.train, options
        self.positions = torch.from_numpy(scene.cloud.points.copy()).half().float().to(device)
        values = torch.full((len(scene.cloud), 4), 0.1)
        values[:, :3] = torch.from_numpy(scene.cloud.colors.copy()).clamp(0.05, 0.95)
        self.optimiser = Adam({"logits": values.logit().to(device)}, {"logits": options.rate})

    @property
    def count(self):
        return len(self.positions)

    def stage(self):
        return "colors"

    def views(self):
        return self.shuffled(len(self.train))

    def step(self):
        self.iteration += 1
        view, back = self.next_view(), self.train.background
        truth = torch.from_numpy(self.train.images[view]).to(self.device)
        target = over(truth[..., :3], truth[..., 3], back)
        values = self.optimiser["logits"].sigmoid()
        splats = draw([blobs(self.positions, values, self.options.size)], self.train.cameras[view])
        loss = photometric_loss(over(splats.features, splats.alpha, back), target)
        losses = self.numbers({"loss": loss})
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return losses

    def checkpoint(self):
        state = super().checkpoint()
        state.arrays["positions"] = self.positions
        return state

    @staticmethod
    def restored(state, options):
        """As it will be stored: 8 bits per value."""
        (label,) = state.scenes
        levels = (255.0 * state.value("logits").sigmoid()).round().to(torch.uint8)
        return ToyModel(
            [Blobs(label.name, label.background, options.size, state.arrays["positions"], levels)]
        )


@dataclass(frozen=True)
class Blobs:
    """A scene as it is stored: positions [N, 3] and levels [N, 4] of 8 bits."""

    name: str
    background: tuple[float, float, float]
    size: float
    positions: torch.Tensor
    levels: torch.Tensor

    def __len__(self):
        return len(self.positions)


class ToyModel(SceneModel):
    """Scenes of blobs, rendered as SceneModel renders all scenes: by their Gaussians."""

    method = "toy-blobs"

    def gaussians(self, scene, camera, edit):
        factor = opacity_factor(self.method, scene.name, edit)
        return blobs(scene.positions, scene.levels.float() / 255.0, scene.size, factor)

    def save(self, folder, rate=None):
        if rate is not None:
            raise Refused("toy-blobs has one size")
        ledger = {}
        for scene in map(self.scene, self.scenes):
            tensors = {"positions": scene.positions.half().cpu(), "levels": scene.levels.cpu()}
            about = {
                "format": FORMAT,
                "scene": scene.name,
                "background": scene.background,
                "size": scene.size,
            }
            data = to_safetensors(tensors, metadata={"model": json.dumps(about)})
            (folder / f"{quote(scene.name, safe=' ')}{SUFFIX}").write_bytes(data)
            parts = {part: v.numel() * v.element_size() for part, v in tensors.items()}
            ledger[scene.name] = parts | {"metadata": len(data) - sum(parts.values())}
        return ledger

    @classmethod
    def load(cls, folder, device):
        return cls([_read(file, device) for file in saved_files(folder, SUFFIX, cls.method)])


def _read(file, device):
    try:
        with safe_open(file, framework="pt") as opened:
            about = json.loads((opened.metadata() or {})["model"])
            positions, levels = opened.get_tensor("positions"), opened.get_tensor("levels")
        if about["format"] != FORMAT or levels.dtype != torch.uint8 or levels.shape != (len(positions), 4):
            raise ValueError("another format")
        background, size = tuple(map(float, about["background"])), float(about["size"])
        return Blobs(about["scene"], background, size, positions.float().to(device), levels.to(device))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DataError(file, f"not a scene of toy-blobs ({error})", "Save the model again") from error


class ToyBlobs(TrainerMethod):
    """Every scene is fitted on its own; TrainerMethod does what all such methods do alike."""

    name, trainer, model = "toy-blobs", Trainer, ToyModel
