"""Datasets that users write: one TOML file each, checked when it is read."""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from econgs_bench.datasets.colors import REMEDY as COLORS
from econgs_bench.datasets.colors import hex_color
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth.sampling import samples_of
from econgs_bench.datasets.procedural import FIELDS
from econgs_bench.datasets.toml import read_toml, sentence

REMEDY = "Mend it: `bench scenes VOLUME` writes such a file, with a comment for each key"

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)]


def _color(value: object) -> object:
    """The channels of ``#3366ff``; other values as they are, but for numbers up to 255."""
    if isinstance(value, str):
        return hex_color(value)
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"{value!r} is no color. {COLORS}")
    if all(type(one) in (int, float) for one in value) and not all(0.0 <= one <= 1.0 for one in value):
        raise ValueError(f"{value} is no color, whose channels go from 0 to 1. {COLORS}")
    return value


Color = Annotated[tuple[Share, Share, Share], BeforeValidator(_color)]
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
    """A trapezoid of opacity (:class:`.datasets.transfer.Bump`)."""

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
    """An isosurface (:class:`.datasets.scene.Isosurface`)."""

    name: Name
    value: Annotated[float, Field(gt=0.0, lt=1.0)]
    color: Color
    opacity: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class Light(_Part):
    """Light and material (:class:`.datasets.scene.Light`)."""

    direction: tuple[float, float, float] | None = None
    ambient: Annotated[float, Field(ge=0.0)] = 0.4
    diffuse: Annotated[float, Field(ge=0.0)] = 0.7
    specular: Annotated[float, Field(ge=0.0)] = 0.2
    shininess: Positive = 20.0
    model: Literal["blinn-phong", "phong"] = "blinn-phong"


class Scene(_Part):
    """A basic scene: bumps of a transfer function, a map of ParaView, or isosurfaces."""

    name: Name
    variable: str = "value"
    bumps: list[Bump] = []
    isosurfaces: list[Surface] = []
    transfer: Annotated[str, Field(min_length=1)] | None = None
    preset: str = ""
    rescale: bool = False
    background: Color = (1.0, 1.0, 1.0)
    reference_length: Positive = 0.01
    depth_enhancement: Annotated[float, Field(ge=0.0)] = 0.0
    light: Light = Light()

    @model_validator(mode="after")
    def _shows_something(self) -> Scene:
        if not self.bumps and not self.isosurfaces and self.transfer is None:
            raise ValueError(f"scene {self.name} has neither bumps nor isosurfaces nor a map (transfer)")
        if self.transfer is not None and (self.bumps or self.isosurfaces):
            raise ValueError(f"scene {self.name} has a map (transfer) beside bumps or isosurfaces; keep one")
        if self.transfer is None and (self.preset or self.rescale):
            raise ValueError(f"scene {self.name} has no map (transfer) to choose from or to rescale")
        return self


class File(_Part):
    """A volume file; its path is relative to the TOML file or to a folder of BENCH_DATA."""

    path: Annotated[str, Field(min_length=1)]
    variable: str = "value"
    array: str | None = None
    step: Annotated[int, Field(ge=0)] | None = None
    resolution: Annotated[int, Field(ge=2)] | None = None
    range: tuple[float, float] | Literal["all"] | None = None
    missing: float | list[float] = []
    url: Annotated[str, Field(pattern=r"^https?://[^/\s]+/\S+$")] | None = None
    sha512: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")] | None = None

    @model_validator(mode="after")
    def _ascends(self) -> File:
        ends = self.range
        if isinstance(ends, tuple) and not (ends[0] < ends[1] and math.isfinite(ends[1] - ends[0])):
            raise ValueError(f"range {list(ends)} does not ascend: the least value, then the greatest")
        return self

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
    """What views show (:class:`.datasets.scene.Frame`)."""

    centre: tuple[Coordinate, Coordinate, Coordinate]
    radius: Annotated[float, Field(ge=0.05, le=2.0)]


class Entry(_Part):
    """A dataset of volumes: of files, or of a formula of :mod:`.datasets.procedural`."""

    title: str = ""
    kind: Literal["volume", "procedural"] = "volume"
    field: str | None = None
    resolution: Annotated[int, Field(ge=8, le=1024)] | None = None
    dims: tuple[int, int, int] | None = None
    spacing: tuple[Positive, Positive, Positive] | None = None
    acknowledgement: str = ""
    files: list[File] = []
    scenes: Annotated[list[Scene], Field(min_length=1)]
    frame: Frame | None = None
    samples: Annotated[int | str, BeforeValidator(_checked_samples)] = "auto"
    compositions: dict[Name, Annotated[list[str], Field(min_length=2)]] = {}

    @property
    def variables(self) -> list[str]:
        """Names of the volumes."""
        return list(FIELDS[self.field]) if self.field else [file.variable for file in self.files]

    @model_validator(mode="after")
    def _has_volumes(self) -> Entry:
        given = [key for key in ("files", "dims", "spacing") if getattr(self, key)]
        if self.kind == "volume":
            if not self.files:
                raise ValueError("files is missing: name at least one volume file")
            if self.field is not None or self.resolution is not None:
                raise ValueError('field and resolution are of kind = "procedural"')
        elif self.field not in FIELDS:
            raise ValueError(f"field {self.field!r} is no set of formulas: {', '.join(FIELDS)}")
        elif given:
            raise ValueError(f"{given[0]} is of volume files; a formula has none")
        return self

    @model_validator(mode="after")
    def _names_fit(self) -> Entry:
        variables = self.variables
        scenes = [scene.name for scene in self.scenes]
        for kind, names in (("variable", variables), ("scene", [*scenes, *self.compositions, "all"])):
            twice = [name for i, name in enumerate(names) if name in names[:i]]
            if twice:
                raise ValueError(f"the {kind} name {twice[0]} occurs twice")
        for scene in self.scenes:
            if scene.variable not in variables:
                has = "no file has" if self.files else "the formula lacks"
                raise ValueError(f"scene {scene.name} is of variable {scene.variable}, which {has}")
        for name, parts in self.compositions.items():
            for part in parts:
                if part not in scenes:
                    raise ValueError(f"composition {name} names the scene {part}, which is not there")
        return self


KEYS = sorted({key for part in _Part.__subclasses__() for key in part.model_fields})


def read_entry(path: Path) -> dict[str, Any]:
    """A checked entry as a table; what is optional and not given is left out.

    Raises:
        DataError: as :func:`.datasets.toml.read_toml`.
    """
    entry = read_toml(path, Entry, REMEDY, KEYS)
    whole = {"title": f"scenes of {path.name}", "acknowledgement": ""} | entry.model_dump(exclude_unset=True)
    whole["kind"] = entry.kind
    for table, scene in zip(whole["scenes"], entry.scenes, strict=True):
        table["variable"] = scene.variable
    if entry.files:
        whole["files"] = [file.model_dump(exclude_none=True) for file in entry.files]
    return whole


def checked_scenes(tables: Any, variables: list[str]) -> list[dict[str, Any]]:
    """Tables of scenes that are in no file, checked as those of a file; empty lists are left out.

    Args:
        tables: list of tables.
        variables: of the dataset.

    Raises:
        DataError: they do not follow the schema; the reason is one sentence.
    """
    whole = {"files": [{"path": "-", "variable": variable} for variable in variables], "scenes": tables}
    try:
        entry = Entry.model_validate(whole)
    except ValidationError as error:
        raise DataError("these scenes", sentence(error, KEYS), "Change it back, or undo") from error
    dumped = entry.model_dump(exclude_unset=True)["scenes"]
    return [
        {key: value for key, value in scene.items() if value not in ([], None)}
        | {"variable": checked.variable}
        for scene, checked in zip(dumped, entry.scenes, strict=True)
    ]
