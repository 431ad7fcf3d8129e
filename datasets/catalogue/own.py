"""Datasets that users write: one TOML file each, checked when it is read."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from datasets.errors import DataError
from datasets.ground_truth.sampling import samples_of
from datasets.toml import read_toml

REMEDY = "Mend it as docs/guide/data.md shows"

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)]
Color = tuple[Share, Share, Share]
Coordinate = Annotated[float, Field(ge=-1.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _checked_samples(value: object) -> object:
    try:
        samples_of(value, "samples")
    except DataError as error:
        raise ValueError(f"{error.reason}. {error.remedy}") from error
    return value


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False)


class Bump(_Part):
    """A trapezoid of opacity (:class:`datasets.transfer.Bump`)."""

    name: Name
    range: tuple[Share, Share, Share, Share]
    color: Color
    opacity: Annotated[float, Field(ge=0.0, lt=1.0)]

    @model_validator(mode="after")
    def _ascends(self) -> Bump:
        if list(self.range) != sorted(self.range):
            raise ValueError(f"range {list(self.range)} does not ascend: starts, full, full, ends")
        return self


class Surface(_Part):
    """An isosurface (:class:`datasets.scene.Isosurface`)."""

    name: Name
    value: Annotated[float, Field(gt=0.0, lt=1.0)]
    color: Color
    opacity: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class Light(_Part):
    """Light and material (:class:`datasets.scene.Light`)."""

    direction: tuple[float, float, float] | None = None
    ambient: Annotated[float, Field(ge=0.0)] = 0.4
    diffuse: Annotated[float, Field(ge=0.0)] = 0.7
    specular: Annotated[float, Field(ge=0.0)] = 0.2
    shininess: Positive = 20.0
    model: Literal["blinn-phong", "phong"] = "blinn-phong"


class Scene(_Part):
    """A basic scene: bumps of a transfer function, or isosurfaces."""

    name: Name
    variable: str = "value"
    bumps: list[Bump] = []
    isosurfaces: list[Surface] = []
    background: Color = (1.0, 1.0, 1.0)
    reference_length: Positive = 0.01
    depth_enhancement: Annotated[float, Field(ge=0.0)] = 0.0
    light: Light = Light()

    @model_validator(mode="after")
    def _shows_something(self) -> Scene:
        if not self.bumps and not self.isosurfaces:
            raise ValueError(f"scene {self.name} has neither bumps nor isosurfaces")
        return self


class File(_Part):
    """A volume file; its path is relative to the TOML file or to a folder of BENCH_DATA."""

    path: Annotated[str, Field(min_length=1)]
    variable: str = "value"
    array: str | None = None
    step: Annotated[int, Field(ge=0)] | None = None
    resolution: Annotated[int, Field(ge=2)] | None = None
    url: Annotated[str, Field(pattern=r"^https?://[^/\s]+/\S+$")] | None = None
    sha512: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")] | None = None

    @model_validator(mode="after")
    def _can_be_fetched(self) -> File:
        path = PurePosixPath(self.path)
        if self.url and not self.sha512:
            raise ValueError("a url needs the sha512 of its file")
        if self.url and (path.is_absolute() or ".." in path.parts):
            raise ValueError(
                f"path {self.path} leaves the folder of data, into which its url would be fetched"
            )
        return self


class Frame(_Part):
    """What views show (:class:`datasets.scene.Frame`)."""

    centre: tuple[Coordinate, Coordinate, Coordinate]
    radius: Annotated[float, Field(ge=0.05, le=2.0)]


class Entry(_Part):
    """A dataset of volumes."""

    title: str = ""
    kind: Literal["volume"] = "volume"
    dims: tuple[int, int, int] | None = None
    spacing: tuple[Positive, Positive, Positive] | None = None
    acknowledgement: str = ""
    files: Annotated[list[File], Field(min_length=1)]
    scenes: Annotated[list[Scene], Field(min_length=1)]
    frame: Frame | None = None
    samples: Annotated[int | str, BeforeValidator(_checked_samples)] = "auto"
    compositions: dict[Name, Annotated[list[str], Field(min_length=2)]] = {}

    @model_validator(mode="after")
    def _names_fit(self) -> Entry:
        variables = [file.variable for file in self.files]
        scenes = [scene.name for scene in self.scenes]
        for kind, names in (("variable", variables), ("scene", [*scenes, *self.compositions, "all"])):
            twice = [name for i, name in enumerate(names) if name in names[:i]]
            if twice:
                raise ValueError(f"the {kind} name {twice[0]} occurs twice")
        for scene in self.scenes:
            if scene.variable not in variables:
                raise ValueError(f"scene {scene.name} is of variable {scene.variable}, which no file has")
        for name, parts in self.compositions.items():
            for part in parts:
                if part not in scenes:
                    raise ValueError(f"composition {name} names the scene {part}, which is not there")
        return self


KEYS = sorted({key for part in _Part.__subclasses__() for key in part.model_fields})


def read_entry(path: Path) -> dict[str, Any]:
    """A checked entry as a table; what is optional and not given is left out.

    Raises:
        DataError: as :func:`datasets.toml.read_toml`.
    """
    entry = read_toml(path, Entry, REMEDY, KEYS)
    whole = {"title": f"scenes of {path.name}", "acknowledgement": ""} | entry.model_dump(exclude_unset=True)
    whole["kind"] = entry.kind
    for table, scene in zip(whole["scenes"], entry.scenes, strict=True):
        table["variable"] = scene.variable
    whole["files"] = [file.model_dump(exclude_none=True) for file in entry.files]
    return whole
