"""The methods sz3 and zfp: nothing is learned; volumes are compressed, and drawn by the ray marcher."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.datasets.render_views import volume_digest
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.methods.interface import Budget, Checkpoint, Model, Monitor, Refused, SceneInput
from econgs_bench.methods.volume.codecs import Codec, Sz3, Zfp
from econgs_bench.methods.volume.model import VolumeModel, VolumeScene, definitions
from econgs_bench.methods.volume.stored import Samples


class VolumeMethod(ABC):
    """A :class:`.methods.interface.Method` that stores the volumes of scenes.

    Attributes:
        name: the method's name, for messages.
    """

    name: str

    @abstractmethod
    def codec(self, options: Any = None) -> Codec:
        """The compressor that options choose, or one that reads what any of them wrote."""

    def partition(self, scenes: Sequence[SceneInput], options: Any) -> list[list[SceneInput]]:
        """The scenes of a variable make a group: they share its volume. So does each scene without one."""
        groups: dict[str, list[SceneInput]] = {}
        for scene in scenes:
            key = f"scene {scene.name}" if scene.volume is None else f"variable {scene.scene.variable}"
            groups.setdefault(key, []).append(scene)
        return list(groups.values())

    def fit(
        self,
        group: Sequence[SceneInput],
        options: Any,
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> VolumeModel:
        """Compress the volumes of a group; see :class:`.methods.interface.Method`.

        Every iteration reports the same: the RMS error of the values, as a share of their range.
        """
        monitor.stage("compression")
        if resume is None:
            samples, scenes = _read(group, self.name)
        else:
            samples, scenes = _kept(resume)
        model = self._model(samples, scenes, options, device)
        loss = _error(model)

        def checkpoint() -> Checkpoint:
            arrays = {f"{i}/{name}": a for i, one in enumerate(samples) for name, a in one.arrays().items()}
            volumes = [one.scalars() for one in samples]
            shown = [[definitions().dump_python(scene, mode="json"), i] for scene, i in scenes]
            return Checkpoint(iteration, arrays, {"volumes": volumes, "scenes": shown})

        for iteration in range(resume.iteration + 1 if resume else 1, budget.iterations + 1):
            monitor.progress(iteration, {"loss": loss}, model.primitives())
            if monitor.due(iteration):
                monitor.pause(iteration, lambda: model, checkpoint)
        return model

    def restore(self, checkpoint: Checkpoint, options: Any, device: str) -> VolumeModel:
        """The model of a checkpoint; all of a fit are alike."""
        return self._model(*_kept(checkpoint), options, device)

    def load(self, folder: Path, device: str) -> VolumeModel:
        """Read a saved model."""
        return VolumeModel.load(folder, self.codec(), device)

    def compose(self, models: Sequence[Model]) -> VolumeModel:
        """One model of the scenes of all: their extinctions add up along each ray, as in the ground truth."""
        own = [model for model in models if isinstance(model, VolumeModel) and model.codec.name == self.name]
        if not own or len(own) < len(models):
            raise Refused(f"{self.name} composes with models of its own only")
        return VolumeModel.join(own)

    def _model(
        self, samples: Sequence[Samples], scenes: Sequence[tuple[BasicScene, int]], options: Any, device: str
    ) -> VolumeModel:
        """The model of scenes, each on the volume of that number."""
        codec = self.codec(options)
        stored = [one.stored(codec, options.error_bound) for one in samples]
        return VolumeModel((VolumeScene(scene, stored[i], samples[i]) for scene, i in scenes), codec, device)


class Sz3Method(VolumeMethod):
    """Volumes compressed by SZ3."""

    name = "sz3"

    def codec(self, options: Any = None) -> Codec:
        return Sz3()


class ZfpMethod(VolumeMethod):
    """Volumes compressed by zfp."""

    name = "zfp"

    def codec(self, options: Any = None) -> Codec:
        return Zfp(options is not None and options.mode == "rate")


def _read(group: Sequence[SceneInput], method: str) -> tuple[list[Samples], list[tuple[BasicScene, int]]]:
    """The volumes of a group, each once, and its scenes with the numbers of their volumes."""
    samples: dict[str, Samples] = {}
    scenes = []
    for each in group:
        if each.volume is None:
            raise Refused(f"{method} stores the volume itself, and scene {each.name!r} has only views")
        if each.scene.transfer is None and not each.scene.isosurfaces:
            raise Refused(f"scene {each.name!r} has neither a transfer function nor isosurfaces")
        volume = each.volume()
        digest = volume_digest(volume)
        if digest not in samples:
            samples[digest] = Samples.of(volume)
        shown = replace(each.scene, background=each.train.background)
        scenes.append((shown, list(samples).index(digest)))
    return list(samples.values()), scenes


def _kept(checkpoint: Checkpoint) -> tuple[list[Samples], list[tuple[BasicScene, int]]]:
    """The same, from a checkpoint."""
    samples = []
    for i, about in enumerate(checkpoint.scalars["volumes"]):
        arrays: Mapping[str, Any] = {
            name: checkpoint.arrays[f"{i}/{name}"]
            for name in ("values", "mask")
            if f"{i}/{name}" in checkpoint.arrays
        }
        samples.append(Samples.restored(arrays, about))
    scenes = [(definitions().validate_python(scene), i) for scene, i in checkpoint.scalars["scenes"]]
    return samples, scenes


def _error(model: VolumeModel) -> float:
    """Root of the mean squared error of a model's values, over all scenes."""
    squares = []
    for name in model.scenes:
        scene = model.scene(name)
        assert scene.samples is not None
        difference = scene.stored.volume.normalised() - scene.samples.values
        squares.append(float(np.mean(np.square(difference), dtype=np.float64)))
    return float(np.sqrt(np.mean(squares)))
