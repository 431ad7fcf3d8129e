"""Base classes of models: scenes under their names, rendered alone or together."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Protocol, Self, TypeVar

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.scene import RGB
from econgs_bench.datasets.units import camera_in_units
from econgs_bench.econgs.anchors.gaussians import Gaussians, draw
from econgs_bench.econgs.splat.composite import over
from econgs_bench.econgs.splat.splats import Splats
from econgs_bench.methods.interface import Edit, Refused, edits_by_scene
from econgs_bench.methods.shared.rendering import Rendering


class Scene(Protocol):
    """A scene of a model; its length is the number of primitives."""

    @property
    def name(self) -> str: ...

    @property
    def background(self) -> RGB: ...

    def __len__(self) -> int: ...


S = TypeVar("S", bound=Scene)


class NamedScenes(Generic[S], ABC):
    """The part of a :class:`.methods.interface.Model` that knows its scenes by name and composites pictures.

    Args:
        scenes: at least one, with distinct names, on one device.

    Raises:
        Refused: two scenes have the same name.
    """

    def __init__(self, scenes: Iterable[S]) -> None:
        pairs = [(scene.name, scene) for scene in scenes]
        self._scenes = dict(pairs)
        if len(self._scenes) != len(pairs):
            raise Refused("two of the scenes to compose have the same name")

    @classmethod
    def join(cls, models: Sequence[Any]) -> Any:
        """One model of the scenes of several, of at least one."""
        return cls(model.scene(name) for model in models for name in model.scenes)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes it holds."""
        return tuple(self._scenes)

    def scene(self, name: str) -> S:
        """A scene of the model.

        Raises:
            UnknownName: it does not hold that scene.
        """
        if name not in self._scenes:
            raise unknown("scene", name, self._scenes, of="this model")
        return self._scenes[name]

    def chosen(self, names: Sequence[str] | None) -> list[S]:
        """The scenes of those names; None: all."""
        return [self.scene(name) for name in (self.scenes if names is None else names)]

    def primitives(self, scene: str | None = None) -> int:
        """Number of primitives of one scene or of all."""
        return sum(map(len, self.chosen(None if scene is None else (scene,))))

    @abstractmethod
    def picture(
        self, scenes: Sequence[S], camera: Camera, edits: Mapping[str, Edit]
    ) -> tuple[Tensor, Tensor]:
        """Premultiplied colors (H, W, 3) and alpha (H, W) of scenes together, without a background.

        Raises:
            Refused: an edit that the method cannot make.
        """

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Render scenes together; see :class:`.methods.interface.Model`."""
        subset = self.chosen(scenes)
        back = subset[0].background if background is None else background
        edits = edits_by_scene(edit, [scene.name for scene in subset])
        with torch.inference_mode():
            colors, alpha = self.picture(subset, camera, edits)
            return over(colors, alpha, back).clamp_(0.0, 1.0), alpha.clamp(0.0, 1.0)


class SceneSet(NamedScenes[S]):
    """A :class:`.methods.interface.Model` of scenes, whatever they are made of.

    A method's model adds ``picture``, ``timings``, ``write`` (or ``write_size``, if it has several) and
    ``load``.

    Args:
        scenes: at least one, with distinct names, on one device.

    Attributes:
        method: name, for messages.
        rendering: units, and the filter of what is splatted.

    Raises:
        Refused: two scenes have the same name.
    """

    method: ClassVar[str]
    rendering: Rendering = Rendering()

    def drawn_by(self, rendering: Rendering) -> Self:
        """The same scenes, drawn in another way."""
        model = copy(self)
        model.rendering = rendering
        return model

    @abstractmethod
    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part."""

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write every file; see :class:`.methods.interface.Model`.

        Raises:
            Refused: the model has no size of that ``rate``.
        """
        ledger = self.write_size(folder, rate)
        if size := self.rendering.write(folder):
            return {**ledger, "": {**ledger.get("", {}), "rendering": size}}
        return ledger

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write the files of a size; the ledger.

        Raises:
            Refused: ``rate`` is given; the model has one size.
        """
        if rate is not None:
            raise Refused(f"{self.method} has no rate knob for saving")
        return self.write(folder)

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write the files of the only size; the ledger."""
        raise NotImplementedError

    @classmethod
    def load(cls, folder: Any, device: str) -> Any:
        """Read what :meth:`save` wrote.

        Raises:
            DataError: a file is missing, damaged or of another kind.
        """
        raise NotImplementedError

    def _in_units(self, camera: Camera) -> Camera:
        """A camera of the scene in the units of the model."""
        units = self.rendering.units
        return camera if units == 1.0 else camera_in_units(camera, 1.0 / units)


class SceneModel(SceneSet[S]):
    """A model of Gaussians: those of all its scenes are concatenated and sorted once.

    A method's model adds ``gaussians``, ``write`` (``write_size``, if it has several), ``load`` and ``join``.

    Attributes:
        preparation: name in :meth:`timings` of the step that makes a frame's Gaussians.
    """

    preparation: Literal["decode", "shade"] = "decode"

    @abstractmethod
    def gaussians(self, scene: S, camera: Camera, edit: Edit) -> Gaussians:
        """The Gaussians of a scene as one camera sees them.

        Raises:
            Refused: an edit that the method cannot make.
        """

    def together(self, scenes: Sequence[S], camera: Camera, edits: Mapping[str, Edit]) -> list[Gaussians]:
        """The Gaussians of scenes that are shown together: those of each, unless scenes share some."""
        return [self.gaussians(scene, camera, edits.get(scene.name, Edit())) for scene in scenes]

    def splatted(
        self, camera: Camera, scenes: Sequence[str] | None = None, edit: Mapping[str, Edit] | None = None
    ) -> Splats:
        """What :meth:`picture` splats; see :class:`.methods.interface.Splatted`."""
        subset = self.chosen(scenes)
        edits = edits_by_scene(edit, [scene.name for scene in subset])
        camera = self._in_units(camera)
        with torch.inference_mode():
            parts = self.together(subset, camera, edits)
            means, quats, scales, opacities, colors = (
                torch.cat([getattr(one, name) for one in parts])
                for name in ("means", "quats", "scales", "opacities", "colors")
            )
        return Splats(means, quats, scales, opacities, colors, camera, low_pass=self.rendering.low_pass)

    def picture(
        self, scenes: Sequence[S], camera: Camera, edits: Mapping[str, Edit]
    ) -> tuple[Tensor, Tensor]:
        """All Gaussians of the scenes, splatted at once."""
        camera = self._in_units(camera)
        splats = draw(self.together(scenes, camera, edits), camera, low_pass=self.rendering.low_pass)
        return splats.features, splats.alpha

    def splats(self, scene: str, camera: Camera) -> tuple[Splats, Tensor]:
        """What is splatted of a scene; see :class:`.methods.interface.HasGaussians`."""
        camera = self._in_units(camera)
        own = self.gaussians(self.scene(scene), camera, Edit())
        fields = (own.means, own.quats, own.scales, own.opacities, own.colors)
        return Splats(*fields, camera, low_pass=self.rendering.low_pass), own.numbers

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part."""
        subset = self.chosen(scenes)
        with torch.inference_mode():
            camera = self._in_units(camera)
            start = seconds()
            parts = self.together(subset, camera, {})
            middle = seconds()
            draw(parts, camera, low_pass=self.rendering.low_pass)
            times = {self.preparation: middle - start, "rasterise": seconds() - middle}
        return {"decode": 0.0, "shade": 0.0} | times


def seconds() -> float:
    """The clock, once the GPU has finished its work."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()
