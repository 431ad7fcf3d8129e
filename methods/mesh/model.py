"""Model of triangle meshes: stored isosurfaces, drawn by VTK."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.edits import edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB, BasicScene
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.mesh.canvas import Drawn, Sheet, canvas
from econgs_bench.methods.mesh.geometry import Mesh, decimated
from econgs_bench.methods.mesh.spec import Coding
from econgs_bench.methods.mesh.storage import decoded, encoded, read_folder, write_scene
from econgs_bench.methods.shared.decoders import own_streams
from econgs_bench.methods.shared.model import NamedScenes, seconds


@dataclass(frozen=True, eq=False)
class Stored:
    """An isosurface as it is stored and drawn.

    Attributes:
        data: its file.
        mesh: what the file holds.
    """

    data: bytes
    mesh: Mesh

    @cached_property
    def sheet(self) -> Sheet | None:
        """The mesh in VTK; None without triangles."""
        return Sheet(self.mesh) if len(self.mesh) else None


@dataclass(frozen=True, eq=False)
class Sizes:
    """What other sizes of a scene are made from.

    Attributes:
        meshes: its isosurfaces, undecimated.
        step: of stored positions, scene units.
    """

    meshes: tuple[Mesh, ...]
    step: float

    def stored(self, share: float, coding: Coding) -> tuple[Stored, ...]:
        """The isosurfaces with a share of their triangles."""
        files = [encoded(decimated(mesh, share), coding, self.step) for mesh in self.meshes]
        with own_streams():
            return tuple(Stored(data, decoded(data, coding)) for data in files)


@dataclass(frozen=True, eq=False)
class MeshScene:
    """A scene of isosurfaces.

    Attributes:
        definition: name, background, light and isosurfaces.
        coding: how meshes are stored.
        surfaces: the meshes of its isosurfaces, in order.
        device: where pictures go.
        sizes: None once loaded.
    """

    definition: BasicScene
    coding: Coding
    surfaces: tuple[Stored, ...]
    device: str
    sizes: Sizes | None = None

    @property
    def name(self) -> str:
        return self.definition.name

    @property
    def background(self) -> RGB:
        return self.definition.background

    def __len__(self) -> int:
        return sum(len(surface.mesh) for surface in self.surfaces)

    def at(self, share: float) -> list[bytes]:
        """The files of its meshes with a share of their triangles.

        Raises:
            Refused: the share is none, or the scene was loaded.
        """
        if not 0.0 < share <= 1.0:
            raise Refused(f"mesh keeps a share of triangles in (0, 1], not {share}")
        if self.sizes is None:
            raise Refused(f"scene {self.name!r} was loaded: mesh cannot save it with other triangles")
        return [one.data for one in self.sizes.stored(share, self.coding)]

    def drawn(self, edit: Edit) -> list[Drawn]:
        """Its surfaces after an edit.

        Raises:
            Refused: an edit that isosurfaces do not allow, or a value out of range.
        """
        try:
            shown = edited(self.definition, edit)
        except DataError as error:
            raise Refused(str(error)) from error
        return [
            Drawn(stored.sheet, surface.color, surface.opacity, shown.light)
            for stored, surface in zip(self.surfaces, shown.isosurfaces, strict=True)
            if stored.sheet is not None
        ]


class MeshModel(NamedScenes[MeshScene]):
    """A :class:`.methods.interface.Model` of isosurfaces, drawn together in their order along each ray."""

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write every file; see :class:`.methods.interface.Model`.

        Args:
            folder: where to.
            rate: share of triangles; default: the option's.

        Raises:
            Refused: a loaded model has no size but its own.
        """
        return {
            scene.name: write_scene(
                folder,
                scene.definition,
                scene.coding,
                [one.data for one in scene.surfaces] if rate is None else scene.at(rate),
            )
            for scene in self.chosen(None)
        }

    @classmethod
    def load(cls, folder: Path, device: str) -> MeshModel:
        """Read what :meth:`save` wrote.

        Raises:
            DataError: a file is missing, damaged or of another kind.
        """
        return cls(
            MeshScene(definition, coding, tuple(Stored(*one) for one in stored), device)
            for definition, coding, stored in read_folder(folder)
        )

    def picture(
        self, scenes: Sequence[MeshScene], camera: Camera, edits: Mapping[str, Edit]
    ) -> tuple[Tensor, Tensor]:
        """All surfaces of the scenes, drawn at once."""
        drawn = [one for scene in scenes for one in scene.drawn(edits.get(scene.name, Edit()))]
        picture = torch.from_numpy(canvas().draw(drawn, camera)).to(scenes[0].device)
        return picture[..., :3], picture[..., 3].clamp(0.0, 1.0)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part; VTK shades while it rasterises."""
        drawn = [one for scene in self.chosen(scenes) for one in scene.drawn(Edit())]
        start = seconds()
        canvas().draw(drawn, camera)
        return {"decode": 0.0, "shade": 0.0, "rasterise": seconds() - start}
