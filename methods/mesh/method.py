"""The method of triangle meshes: extraction, checkpoints, composition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from econgs_bench.datasets.scene import BasicScene, Isosurface, Light
from econgs_bench.methods.interface import Budget, Checkpoint, Model, Monitor, Refused, SceneInput
from econgs_bench.methods.mesh.geometry import Mesh, distance, extracted, level_of
from econgs_bench.methods.mesh.model import MeshModel, MeshScene, Sizes
from econgs_bench.methods.mesh.spec import MeshOptions


@dataclass(frozen=True, eq=False)
class _Extraction:
    """What a fit finds, and what its checkpoints hold.

    Attributes:
        definition: name, background, light and isosurfaces.
        meshes: its isosurfaces, undecimated.
        voxel: smallest side of a voxel, scene units.
    """

    definition: BasicScene
    meshes: tuple[Mesh, ...]
    voxel: float

    def model(self, options: MeshOptions, device: str) -> MeshModel:
        """The model with the options' share of triangles."""
        sizes = Sizes(self.meshes, options.step * self.voxel)
        stored = sizes.stored(options.kept, options.coding)
        return MeshModel([MeshScene(self.definition, options.coding, stored, device, sizes)])

    def checkpoint(self, iteration: int, loss: float) -> Checkpoint:
        scene, arrays = self.definition, {}
        for number, mesh in enumerate(self.meshes):
            arrays[f"{number}/points"] = torch.from_numpy(mesh.points.copy())
            arrays[f"{number}/faces"] = torch.from_numpy(mesh.faces.copy())
        scalars = {
            "scene": scene.name,
            "background": list(scene.background),
            "light": None if scene.light is None else asdict(scene.light),
            "surfaces": [asdict(surface) for surface in scene.isosurfaces],
            "voxel": self.voxel,
            "loss": loss,
        }
        return Checkpoint(iteration, arrays, scalars)

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> _Extraction:
        """The extraction of a checkpoint."""
        scalars, arrays = checkpoint.scalars, checkpoint.arrays
        definition = BasicScene(
            scalars["scene"],
            light=None if scalars["light"] is None else Light(**scalars["light"]),
            background=tuple(scalars["background"]),
            isosurfaces=tuple(Isosurface(**surface) for surface in scalars["surfaces"]),
        )
        meshes = tuple(
            Mesh.of(arrays[f"{number}/points"].cpu().numpy(), arrays[f"{number}/faces"].cpu().numpy())
            for number in range(len(definition.isosurfaces))
        )
        return cls(definition, meshes, scalars["voxel"])


class MeshMethod:
    """A :class:`.methods.interface.Method` of triangle meshes; each scene is a group of its own."""

    def partition(self, scenes: Sequence[SceneInput], options: MeshOptions) -> list[list[SceneInput]]:
        """One group per scene."""
        return [[scene] for scene in scenes]

    def fit(
        self,
        group: Sequence[SceneInput],
        options: MeshOptions,
        budget: Budget,
        seed: int,
        device: str,
        monitor: Monitor,
        resume: Checkpoint | None = None,
    ) -> MeshModel:
        """Extract, decimate and encode, all in the first iteration; see :class:`.methods.interface.Method`.

        The loss is the mean distance of the stored triangles from their level sets, in voxels. Chance has no
        part in it, and further iterations change nothing.

        Raises:
            Refused: the scene shows no isosurfaces or is darkened by depth, or a package is missing.
        """
        if len(group) != 1:
            raise Refused(f"mesh extracts each scene on its own, not {len(group)} together")
        if resume is None:
            monitor.stage("extraction")
            done, model, loss = _extracted(group[0], options, device)
        else:
            done, loss = _Extraction.of(resume), resume.scalars["loss"]
            model = done.model(options, device)
        for iteration in range(1 if resume is None else resume.iteration + 1, budget.iterations + 1):
            monitor.progress(iteration, {"loss": loss}, model.primitives())
            if monitor.due(iteration):
                monitor.pause(iteration, lambda: model, partial(done.checkpoint, iteration, loss))
        return model

    def restore(self, checkpoint: Checkpoint, options: MeshOptions, device: str) -> MeshModel:
        """The model of a checkpoint."""
        return _Extraction.of(checkpoint).model(options, device)

    def load(self, folder: Path, device: str) -> MeshModel:
        """Read a saved model."""
        return MeshModel.load(folder, device)

    def compose(self, models: Sequence[Model]) -> Any:
        """One model of the scenes of all."""
        if not models or not all(isinstance(model, MeshModel) for model in models):
            raise Refused("mesh composes with models of its own only")
        return MeshModel.join(models)


def _extracted(scene: SceneInput, options: MeshOptions, device: str) -> tuple[_Extraction, MeshModel, float]:
    """What a fit finds, its model, and its loss."""
    definition = scene.scene
    if not definition.isosurfaces:
        what = "a transfer function" if definition.transfer is not None else "only views"
        raise Refused(f"mesh represents isosurfaces, and scene {scene.name!r} has {what}")
    if definition.depth_enhancement > 0.0:
        raise Refused(f"mesh has no depth enhancement, which darkens scene {scene.name!r}")
    if scene.volume is None:
        raise Refused(f"mesh reads the volume itself, and scene {scene.name!r} has only views")
    volume = scene.volume()
    kept = BasicScene(
        scene.name,
        light=definition.light,
        background=scene.train.background,
        isosurfaces=definition.isosurfaces,
    )
    done = _Extraction(kept, tuple(extracted(volume, kept.isosurfaces)), volume.voxel)
    model = done.model(options, device)
    far = [
        (distance(volume, level_of(surface), stored.mesh), len(stored.mesh))
        for surface, stored in zip(kept.isosurfaces, model.scene(scene.name).surfaces, strict=True)
    ]
    total = sum(count for _, count in far)
    return done, model, sum(mean * count for mean, count in far) / max(total, 1)
