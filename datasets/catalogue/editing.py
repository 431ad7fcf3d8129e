"""Scenes of an open dataset as tables that a page edits, and the TOML file that holds them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.auto_transfer import automatic_scenes
from econgs_bench.datasets.catalogue import entries
from econgs_bench.datasets.catalogue.files import FileField
from econgs_bench.datasets.catalogue.opening import scenes_of
from econgs_bench.datasets.catalogue.own import File, checked_scenes, read_entry
from econgs_bench.datasets.catalogue.proposal import quoted, write_text
from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.datasets.scene import BasicScene, Dataset, Light
from econgs_bench.datasets.visibility import Samples

Table = dict[str, Any]
"""A table of the TOML file, as :mod:`.datasets.catalogue.own` describes it."""
BINS, SIDE = 256, 128
"""Bins of values, and of values and gradients along each axis."""
_STEEP = 0.999  # share of the samples whose gradients the picture holds


class Histogram(NamedTuple):
    """How often values occur.

    Attributes:
        counts: (BINS,) float32 samples by normalised value.
        density: (SIDE, SIDE) float32 samples by gradient magnitude (rows, weakest first) and value.
        value_range: data values that are 0 and 1.
    """

    counts: NDArray[np.float32]
    density: NDArray[np.float32]
    value_range: tuple[float, float]


class Editable:
    """The scenes of a dataset of volumes, and where its files are.

    Args:
        name: by which the dataset was opened: in the catalogue, or a path.
        dataset: with volumes.
    """

    def __init__(self, name: str, dataset: Dataset) -> None:
        self.dataset = dataset
        (base, _, at), path = name.partition("@"), Path(name).expanduser()
        self._table: Table = {}
        self._folders = [Path.cwd(), *entries.data_folders()]
        if base in entries.names():
            self._table, self._folders = entries.entry(base), entries.folders_of(base)
        elif path.suffix == ".toml":
            self._table = read_entry(path)
            self._folders = [path.resolve().parent, *entries.data_folders()]
        if self._table.get("kind") == "procedural":
            made = {"field": self._table.get("field", base)} | ({"resolution": int(at)} if at else {})
            self._table = {key: one for key, one in self._table.items() if key != "dims"} | made
        maps = {one["name"]: one for one in self._table.get("scenes", []) if "transfer" in one}
        self._maps = {one["transfer"] for one in maps.values()}
        self.tables = [table_of(scene, maps.get(scene.name)) for scene in dataset.scenes]
        """The scenes as opened."""

    def checked(self, tables: Any) -> list[Table]:
        """Tables of a page, as :func:`.datasets.catalogue.own.checked_scenes` gives them.

        Raises:
            DataError: they do not follow the schema, or name a map outside the folders of data.
        """
        checked = checked_scenes(tables, list(self.dataset.volumes))
        for table in checked:
            name = table.get("transfer", "")
            path = Path(name)
            if name not in self._maps and (path.is_absolute() or ".." in path.parts):
                raise DataError(
                    printable(name), "leads out of the folders of data", "Put the map beside the file"
                )
        return checked

    def scenes(self, tables: Any) -> tuple[BasicScene, ...]:
        """Basic scenes of tables.

        Raises:
            DataError: as :meth:`checked`; a map is missing or unusable.
        """
        return scenes_of(self.dataset, self.checked(tables), self._folders)

    def proposed(self, variable: str) -> list[Table]:
        """Automatic scenes of a variable, as `bench scenes` proposes them."""
        return [table_of(scene) for scene in automatic_scenes(self.dataset.volume(variable))]

    def histogram(self, variable: str) -> Histogram:
        """Values and gradients of a variable's samples, of a regular subset if it is large.

        Raises:
            DataError: there is no such variable, or its file is unusable.
        """
        volume = self.dataset.volume(variable)
        samples = Samples.of(volume, SIDE)
        values, slope = samples.values[samples.valid], samples.slope(samples.values)[samples.valid]
        steepest = float(np.quantile(slope, _STEEP)) or 1.0
        ends = ((0.0, steepest), (0.0, 1.0))
        density = np.histogram2d(np.minimum(slope, steepest), values, SIDE, ends)[0].astype(np.float32)
        counts = np.histogram(values, BINS, (0.0, 1.0))[0].astype(np.float32)
        low, high = volume.value_range
        return Histogram(counts, density, (float(low), float(high)))

    def write(
        self, scenes: Sequence[BasicScene], tables: Sequence[Table], path: Path, *, over: bool = False
    ) -> str:
        """Write the dataset with other scenes, as `bench run --dataset` takes it.

        Args:
            scenes: what is shown.
            tables: from :meth:`checked`, of scenes whose maps are kept.
            path: TOML file, in the folder that is searched for files first.
            over: whether a file of that name may be replaced.

        Returns:
            The text of the file.

        Raises:
            DataError: several datasets are joined, or the file exists or cannot be written.
        """
        made = self._table.get("kind") == "procedural"
        files = [] if made else [self._file(variable, path.parent) for variable in self.dataset.volumes]
        given = {one["name"]: one for one in tables if "transfer" in one}
        written = [table_of(scene, given.get(scene.name)) for scene in scenes]
        for table in written:
            if "transfer" in table:
                table["transfer"] = self._place(table["transfer"], path.parent)
        names = {scene.name for scene in scenes}
        compositions = {
            name: list(parts)
            for name, parts in self._table.get("compositions", self.dataset.compositions).items()
            if name != "all" and names.issuperset(parts)
        }
        frame = self.dataset.frame
        place: Table = {}
        if frame is None and not made:
            radius = 0.5 * max(
                float(np.linalg.norm(self.dataset.volume(one).extent)) for one in self.dataset.volumes
            )
            place = {"centre": [0.0, 0.0, 0.0], "radius": radius}
        elif frame is not None:
            place = {"centre": list(frame.centre), "radius": frame.radius}
        kept = ("title", "kind", "field", "resolution", "dims", "spacing", "acknowledgement", "samples")
        table = {key: self._table[key] for key in kept if key in self._table} or {"title": self.dataset.title}
        whole = {**table, **({"frame": place} if place else {}), "files": files, "scenes": written}
        if compositions:
            whole["compositions"] = compositions
        text = (
            f"# Scenes of {self.dataset.name}, edited in `bench view`.\n"
            + "\n".join(_lines(whole, ()))
            + "\n"
        )
        write_text(text, path, over=over)
        return text

    def _file(self, variable: str, folder: Path) -> Table:
        """The table of a variable's file, with the range that scenes refer to."""
        field = self.dataset.volumes[variable]
        table: Table
        files = [one for one in self._table.get("files", ()) if one["variable"] == variable]
        if isinstance(field, FileField):
            one = field.request
            ends = list(one.value_range) if isinstance(one.value_range, tuple) else one.value_range
            table = {
                "path": str(one.path), "variable": variable, "array": one.variable, "step": one.step,
                "resolution": one.resolution, "range": ends, "missing": list(one.missing) or None,
            }  # fmt: skip
            table = {key: value for key, value in table.items() if value is not None}
        elif files:
            table = {key: value for key, value in files[0].items() if key in File.model_fields}
        else:
            reason = "is several datasets, and a TOML file of scenes holds one"
            raise DataError(self.dataset.name, reason, "Open one of them")
        if "range" not in table:
            table["range"] = [float(end) for end in self.dataset.volume(variable).value_range]
        path = self._place(table["path"], folder)
        if path != table["path"]:
            table = {key: value for key, value in table.items() if key not in ("url", "sha512")}
        return {**table, "path": path}

    def _place(self, path: str, folder: Path) -> str:
        """A path by which an entry in a folder finds what this dataset's path means."""
        at = entries.locate(path, self._folders)
        again = entries.locate(path, [folder, *entries.data_folders()])
        if at is None or (again is not None and again.samefile(at)):
            return path
        at = at.resolve()
        return at.relative_to(folder).as_posix() if at.is_relative_to(folder) else str(at)


def table_of(scene: BasicScene, given: Table | None = None) -> Table:
    """The table of a basic scene; of ``given``, which names a map of ParaView, the map is kept."""
    table: Table = {"name": scene.name, "variable": scene.variable}
    if given is not None:
        table |= {key: given[key] for key in ("transfer", "preset", "rescale") if key in given}
    elif scene.transfer is not None:
        table["bumps"] = [
            {
                "name": safe(bump.name),
                "range": [_share(end) for end in (bump.start, bump.rise, bump.fall, bump.end)],
                "color": list(bump.color),
                "opacity": bump.opacity,
            }
            for bump in scene.transfer.bumps
        ]
    if scene.transfer is not None:
        table["reference_length"] = scene.transfer.reference_length
    if scene.isosurfaces:
        table["isosurfaces"] = [{**asdict(one), "color": list(one.color)} for one in scene.isosurfaces]
    table["background"] = list(scene.background)
    if scene.light is not None and scene.light != Light():
        light = {key: value for key, value in asdict(scene.light).items() if value is not None}
        table["light"] = {key: list(one) if isinstance(one, tuple) else one for key, one in light.items()}
    if scene.depth_enhancement:
        table["depth_enhancement"] = scene.depth_enhancement
    return table


def safe(name: str) -> str:
    """A name of a bump that the schema allows."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("_.-")[:60] or "bump"


def _share(value: float) -> float:
    return round(min(max(float(value), 0.0), 1.0), 6)


def _lines(table: Mapping[str, Any], place: tuple[str, ...]) -> Iterator[str]:
    """The lines of a table: its values, then the tables in it."""
    inner = {}
    for key, value in table.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            inner[key] = value
        elif key == "compositions":
            inner[key] = [value]
        elif value not in ("", []):
            yield f"{_key(key)} = {_value(value)}"
    for key, tables in inner.items():
        name = ".".join((*place, _key(key)))
        for one in tables:
            yield ""
            yield f"[{name}]" if key == "compositions" else f"[[{name}]]"
            yield from _lines(one, (*place, key))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else quoted(name)


def _value(value: Any) -> str:
    """A value of JSON's kinds as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_value(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return quoted(value) if isinstance(value, str) else repr(value)
