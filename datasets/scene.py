"""Scenes and datasets: the objects that methods represent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

RGB = tuple[float, float, float]
WHITE: RGB = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Light:
    """Light and material of one basic scene.

    Attributes:
        direction: unit vector from the object to a directional light in world space, or None for
            a headlight at the camera.
        ambient, diffuse, specular: coefficients >= 0; specular light is white.
        shininess: exponent > 0.
        model: "blinn-phong" (highlight from n.h) or "phong" (from r.v, as VTK does).
    """

    direction: tuple[float, float, float] | None = None
    ambient: float = 0.4
    diffuse: float = 0.7
    specular: float = 0.2
    shininess: float = 20.0
    model: Literal["blinn-phong", "phong"] = "blinn-phong"


@dataclass(frozen=True)
class Isosurface:
    """A level set drawn as a surface.

    Attributes:
        name: structure of the surface ("skin").
        value: normalised value of the level set, in (0, 1).
        color: displayed sRGB color, three values in [0, 1].
        opacity: opacity of one crossing, in (0, 1], whatever the ray step.
    """

    name: str
    value: float
    color: RGB
    opacity: float = 1.0


@dataclass(frozen=True)
class BasicScene:
    """One transfer function (or set of isosurfaces) on one variable with one light and one background.

    Attributes:
        name: identifier within the dataset.
        variable: name of its volume ("" for pre-rendered scenes).
        transfer: None for pre-rendered scenes and for isosurfaces.
        light: None renders unshaded (emission-absorption).
        isosurfaces: level sets drawn instead of a transfer function; empty otherwise.
        depth_enhancement: strength in [0, 1] of the darkening of deep or hidden parts
            (:mod:`.datasets.ground_truth.model`); 0 is off.
        views_folder: folder of pre-rendered views (:mod:`.datasets.posed_images`).
    """

    name: str
    variable: str = ""
    transfer: TransferFunction | None = None
    light: Light | None = field(default_factory=Light)
    background: RGB = WHITE
    views_folder: Path | None = None
    isosurfaces: tuple[Isosurface, ...] = ()
    depth_enhancement: float = 0.0


@dataclass(frozen=True)
class Frame:
    """A sphere that views show: cameras look at its centre, and it just fits the shorter side of a picture.

    Attributes:
        centre: x, y, z in scene space.
        radius: in scene space; positive.
    """

    centre: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, eq=False)
class Dataset:
    """Volumes (one per variable), or only views, with basic scenes and named compositions.

    Attributes:
        name: identifier in the catalogue, or a stem made from a file name.
        title: one line for people.
        kind: "volume" renders its ground truth; "views" holds pre-rendered pictures.
        scenes: basic scenes by order of the catalogue.
        compositions: name -> names of basic scenes; empty for "views".
        volumes: variable -> function that reads it; empty for "views".
        samples: rays a pixel of views (:attr:`.datasets.views.ViewRequest.samples`).
        framing: function that finds the frame of all views; None: they show each volume's whole box.
    """

    name: str
    title: str
    kind: Literal["volume", "views"]
    scenes: tuple[BasicScene, ...]
    compositions: dict[str, tuple[str, ...]] = field(default_factory=dict)
    volumes: dict[str, Callable[[], Volume]] = field(default_factory=dict)
    framing: Callable[[Dataset], Frame] | None = None
    samples: int = 0
    _loaded: dict[str, Volume] = field(default_factory=dict, repr=False)
    _frames: list[Frame] = field(default_factory=list, repr=False)

    def scene(self, name: str) -> BasicScene:
        """The basic scene of that name.

        Raises:
            UnknownName: no scene has this name; the remedy lists near matches.
        """
        for scene in self.scenes:
            if scene.name == name:
                return scene
        raise unknown("scene", name, [s.name for s in self.scenes], of=self.name)

    def parts(self, name: str) -> tuple[BasicScene, ...]:
        """The basic scene of that name, or the basic scenes of that composition.

        Raises:
            UnknownName: neither a basic scene nor a composition has it; the remedy lists near matches.
        """
        names = [scene.name for scene in self.scenes]
        if name not in (*names, *self.compositions):
            raise unknown("scene", name, [*names, *self.compositions], of=self.name)
        return tuple(self.scene(part) for part in self.compositions.get(name, (name,)))

    @property
    def frame(self) -> Frame | None:
        """The frame of all views, found once; None: they show each volume's whole box.

        Raises:
            DataError: a volume that it depends on is unusable.
        """
        if self.framing is None:
            return None
        if not self._frames:
            self._frames.append(self.framing(self))
        return self._frames[0]

    def volume(self, variable: str) -> Volume:
        """The volume of a variable, read once.

        Raises:
            UnknownName: the dataset has no such variable.
            DataError: its file is unusable.
        """
        if variable not in self._loaded:
            if variable not in self.volumes:
                raise unknown("variable", variable, self.volumes, of=self.name)
            self._loaded[variable] = self.volumes[variable]()
        return self._loaded[variable]
