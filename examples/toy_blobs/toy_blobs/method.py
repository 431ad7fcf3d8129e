"""The method itself: training, rendering, and the file of a scene."""

from __future__ import annotations

import json
import math
import time
from urllib.parse import quote

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_safetensors

from datasets.errors import DataError
from datasets.names import unknown
from econgs.losses import photometric_loss
from econgs.optim import Adam
from econgs.splat.composite import over, scale_depth
from econgs.splat.rasterise import rasterise
from methods.interface import Checkpoint, Diverged, Refused, edits_by_scene
from methods.shared.method import PerScene

FORMAT = "toy-blobs 1"
SUFFIX = ".blobs"

# ---------------------------------------------------------------- the algorithm


def splat(blobs, camera, opacity=1.0):
    """Blobs (positions [N, 3], values [N, 4] in [0, 1]: color and opacity, size) as seen by a camera."""
    return [
        blobs["positions"],
        torch.eye(4)[:1].to(blobs["positions"]).repeat(len(blobs["positions"]), 1),
        torch.full_like(blobs["positions"], blobs["size"]),
        scale_depth(blobs["values"][:, 3], opacity),
        blobs["values"][:, :3],
    ]


class Trainer:
    """Adam on the color and opacity of every point."""

    def __init__(self, scene, options, iterations, seed, device):
        if len(scene.train) == 0 or len(scene.cloud) == 0:
            raise Refused(f"scene {scene.name!r} has no training views or no cloud")
        self.scene, self.options, self.iterations, self.device = scene, options, iterations, device
        self.positions = torch.from_numpy(scene.cloud.points.copy()).half().float().to(device)
        values = torch.full((len(scene.cloud), 4), 0.1)
        values[:, :3] = torch.from_numpy(scene.cloud.colors.copy()).clamp(0.05, 0.95)
        self.optimiser = Adam({"logits": values.logit().to(device)}, {"logits": options.rate})
        self.generator = torch.Generator().manual_seed(seed)
        self.images = torch.from_numpy(scene.train.images)
        self.iteration = 0

    def run(self, monitor):
        monitor.stage("colors")
        while self.iteration < self.iterations:
            self.iteration += 1
            view = int(torch.randint(len(self.images), (), generator=self.generator))
            truth, back = self.images[view].to(self.device), self.scene.train.background
            camera = self.scene.train.cameras[view]
            splats = rasterise(*splat(self.blobs(), camera), camera)
            target = over(truth[..., :3], truth[..., 3], back)
            loss = photometric_loss(over(splats.features, splats.alpha, back), target)
            if not math.isfinite(float(loss.detach())):
                raise Diverged(f"the loss is {float(loss.detach())} at iteration {self.iteration}")
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            monitor.progress(self.iteration, {"loss": float(loss.detach())}, len(self.positions))
            if monitor.due(self.iteration):
                monitor.pause(self.iteration, self.model, self.checkpoint)

    def blobs(self):
        values = self.optimiser["logits"].sigmoid()
        return {"positions": self.positions, "values": values, "size": self.options.size}

    def model(self):
        """As it will be stored: 8 bits per value."""
        levels = (255.0 * self.blobs()["values"].detach()).round().to(torch.uint8)
        scene = {"background": self.scene.train.background, "size": self.options.size}
        return ToyModel({self.scene.name: scene | {"positions": self.positions, "levels": levels}})

    def checkpoint(self):
        arrays = {name: values.clone() for name, values in self.optimiser.state().items()}
        return Checkpoint(self.iteration, arrays | {"generator": self.generator.get_state()})

    def restore(self, checkpoint):
        arrays = dict(checkpoint.arrays)
        self.generator.set_state(arrays.pop("generator").cpu())
        self.optimiser.load_state({name: values.to(self.device) for name, values in arrays.items()})
        self.iteration = checkpoint.iteration


# ---------------------------------------------------------------- the model


class ToyModel:
    """Scene name -> background, size, positions [N, 3] and levels [N, 4] of 8 bits."""

    def __init__(self, blobs):
        self.blobs = blobs

    @property
    def scenes(self):
        return tuple(self.blobs)

    def primitives(self, scene=None):
        return sum(len(self.blobs[name]["levels"]) for name in ([scene] if scene else self.blobs))

    def render(self, camera, scenes=None, edit=None, background=None):
        names = self.scenes if scenes is None else tuple(scenes)
        for name in names:
            if name not in self.blobs:
                raise unknown("scene", name, self.blobs, of="this model")
        factors = dict.fromkeys(names, 1.0)
        for name, wanted in edits_by_scene(edit, names).items():
            others = [k for k, v in vars(wanted).items() if v is not None and k != "opacity"]
            if others:
                raise Refused(f"toy-blobs cannot edit {', '.join(others)}")
            factors[name] = 1.0 if wanted.opacity is None else wanted.opacity
            if not (math.isfinite(factors[name]) and factors[name] >= 0.0):
                raise Refused(f"opacity factor {factors[name]} is not a finite number >= 0")
        back = self.blobs[names[0]]["background"] if background is None else background
        with torch.inference_mode():
            parts = []
            for name in names:
                values = self.blobs[name]["levels"].float() / 255.0
                parts.append(splat(self.blobs[name] | {"values": values}, camera, factors[name]))
            splats = rasterise(*(torch.cat(column) for column in zip(*parts, strict=True)), camera)
            rgb = over(splats.features, splats.alpha, back)
            return rgb.clamp(0.0, 1.0), splats.alpha.clamp(0.0, 1.0)

    def timings(self, camera, scenes=None):
        start = time.perf_counter()
        self.render(camera, scenes)
        return {"decode": 0.0, "shade": 0.0, "rasterise": time.perf_counter() - start}

    def save(self, folder, rate=None):
        if rate is not None:
            raise Refused("toy-blobs has one size")
        ledger = {}
        for name, scene in self.blobs.items():
            tensors = {"positions": scene["positions"].half().cpu(), "levels": scene["levels"].cpu()}
            about = {"format": FORMAT, "scene": name, "background": scene["background"]}
            text = json.dumps(about | {"size": scene["size"]})
            data = to_safetensors(tensors, metadata={"model": text})
            (folder / f"{quote(name, safe=' ')}{SUFFIX}").write_bytes(data)
            parts = {part: v.numel() * v.element_size() for part, v in tensors.items()}
            ledger[name] = parts | {"metadata": len(data) - sum(parts.values())}
        return ledger


# ---------------------------------------------------------------- behind the interface


class ToyBlobs(PerScene[ToyModel]):
    """Every scene is fitted on its own; PerScene does what all such methods do alike."""

    name = "toy-blobs"

    def trainer(self, scene, options, iterations, seed, device):
        return Trainer(scene, options, iterations, seed, device)

    def owns(self, model):
        return isinstance(model, ToyModel)

    def joined(self, models):
        names = [name for model in models for name in model.scenes]
        if len(set(names)) < len(names):
            raise Refused("two of the scenes to compose have the same name")
        return ToyModel({name: model.blobs[name] for model in models for name in model.scenes})

    def load(self, folder, device):
        files = sorted(folder.glob(f"*{SUFFIX}")) if folder.is_dir() else []
        if not files:
            raise DataError(folder, "no saved toy-blobs model in it", "Give the folder of one")
        return ToyModel(dict(_read(file, device) for file in files))


def _read(file, device):
    try:
        with safe_open(file, framework="pt") as opened:
            about = json.loads((opened.metadata() or {})["model"])
            positions, levels = opened.get_tensor("positions"), opened.get_tensor("levels")
        if about["format"] != FORMAT or levels.dtype != torch.uint8 or levels.shape != (len(positions), 4):
            raise ValueError("another format")
        background, size = tuple(map(float, about["background"])), float(about["size"])
        scene = {"background": background, "size": size, "levels": levels.to(device)}
        return about["scene"], scene | {"positions": positions.float().to(device)}
    except (OSError, SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DataError(file, f"not a scene of toy-blobs ({error})", "Save the model again") from error
