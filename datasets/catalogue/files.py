"""Volume files outside the catalogue: datasets with automatic transfer functions."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.auto_transfer import COLORS, automatic_scenes
from econgs_bench.datasets.catalogue.entries import own_name
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.framing import frame_of, places, visible_frame, visible_voxels
from econgs_bench.datasets.readers import list_variables, read_volume, suffix_of
from econgs_bench.datasets.readers.fields import choose, plain
from econgs_bench.datasets.readers.limits import Limits
from econgs_bench.datasets.readers.naming import FileName
from econgs_bench.datasets.scene import BasicScene, Dataset
from econgs_bench.datasets.visibility import Samples
from econgs_bench.datasets.volume import Volume

MOST_SCENES = 12
"""Limit for a file of several variables: three scenes each, fewer with more than four variables."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FileField:
    """One field of a volume file; a call reads it.

    Attributes:
        request: the file and the choice in it.
        name: name of the variable in the dataset.
        volume: the field itself, where it is in memory already.
    """

    request: FileName
    name: str
    volume: Volume | None = None

    def __call__(self) -> Volume:
        return self.volume if self.volume is not None else _read(self.request, self.name)


def file_dataset(name: str) -> Dataset:
    """The dataset of ``PATH`` or ``PATH:variable=T,step=3,resolution=256``.

    One field has the scenes ``tf1``, ``tf2``... A file of several variables, without a choice, becomes a
    dataset of all of them with the scenes ``T_tf1``...; a log message lists omitted variables with reasons.

    Raises:
        UnknownName: no such variable or key; the remedy lists near matches.
        DataError: the file is unusable, or no variable of it makes a scene.
    """
    request = FileName.parse(name)
    variables = list_variables(request.path)
    if len(variables) > 1 and request.variable is None:
        return _of_all(request, [variable.name for variable in variables])
    if variables:  # the file may spell it otherwise
        request = replace(
            request, variable=choose(request.path, variables, request.variable, None, None).name
        )
    volume = _read(request, None)
    scenes = automatic_scenes(volume)
    names = tuple(scene.name for scene in scenes)
    several = (
        request.variable
        if len(variables) > 1 or (variables and request.variable != variables[0].name)
        else None
    )
    return Dataset(
        _name(request, several),
        f"{request.path.name}, automatic transfer functions",
        "volume",
        scenes,
        {"all": names} if len(names) > 1 else {},
        {volume.name: FileField(request, volume.name, volume)},
        visible_frame,
    )


def safe_name(text: str) -> str:
    """A name for folders, tables and command lines: letters, digits, ``_``, ``-`` and ``.``."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("_.-") or "volume"


def _name(request: FileName, variable: str | None) -> str:
    """The file's stem and the choices, so that tables distinguish them."""
    path = request.path
    parts = [path.name[: len(path.name) - len(suffix_of(path))]]
    parts += [variable] if variable is not None else []
    parts += [f"step{request.step}"] if request.step is not None else []
    parts += [f"r{request.resolution}"] if request.resolution is not None else []
    if request.value_range is not None:
        ends = request.value_range
        parts.append("range" + (ends if ends == "all" else "_".join(f"{end:g}" for end in ends)))
    parts += [f"without{value:g}" for value in request.missing]
    return own_name("-".join(safe_name(part) for part in parts))


def _read(request: FileName, name: str | None) -> Volume:
    return read_volume(
        request.path,
        name,
        array=request.variable,
        step=request.step,
        resolution=request.resolution,
        limits=Limits(request.value_range, request.missing),
    )


def _of_all(request: FileName, variables: list[str]) -> Dataset:
    path = request.path
    scenes: list[BasicScene] = []
    compositions: dict[str, tuple[str, ...]] = {}
    volumes: dict[str, Callable[[], Volume]] = {}
    grids = set()
    omissions: list[str] = []
    visible: list[NDArray[np.float64]] = []
    each = max(1, min(3, MOST_SCENES // len(variables)))
    for variable in variables:
        if len(scenes) + each > MOST_SCENES:
            omissions.append(f"{variable} (more than {MOST_SCENES} scenes)")
            continue
        key = plain(variable) or "value"
        if key in volumes:
            key = f"{key}_{len(volumes)}"
        one = replace(request, variable=variable)
        try:
            volume = _read(one, key)
        except DataError as error:
            omissions.append(f"{variable} ({error.reason})")
            first = error
            continue
        new_scenes = [
            _rename(scene, key, len(scenes) + i) for i, scene in enumerate(automatic_scenes(volume, each))
        ]
        scenes += new_scenes
        samples = Samples.of(volume)
        visible += [places(samples, visible_voxels(samples, scene)) for scene in new_scenes]
        # Read again on demand: all variables together may exceed the memory.
        volumes[key] = FileField(one, key)
        grids.add((volume.dims, volume.spacing))
        if len(new_scenes) > 1:
            compositions[key] = tuple(scene.name for scene in new_scenes)
    if not scenes:
        raise first
    if omissions:
        _log.warning("%s: left out: %s. Choose one with %s:variable=NAME", path, "; ".join(omissions), path)
    if len(grids) == 1 and len(scenes) > 1:
        compositions = {"all": tuple(scene.name for scene in scenes), **compositions}
    title = f"{path.name}, {len(volumes)} variables, automatic transfer functions"
    frame = frame_of(visible)
    return Dataset(
        _name(request, None), title, "volume", tuple(scenes), compositions, volumes, lambda _: frame
    )


def _rename(scene: BasicScene, variable: str, number: int) -> BasicScene:
    """A scene of one of several variables: its own name, and the next color of the palette."""
    name = f"{variable}_{scene.name}"
    if scene.transfer is None:
        return replace(scene, name=name)
    color = COLORS[number % len(COLORS)]
    bumps = tuple(replace(bump, color=color) for bump in scene.transfer.bumps)
    return replace(scene, name=name, transfer=replace(scene.transfer, name=name, bumps=bumps))
