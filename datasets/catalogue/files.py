"""Volume files that the catalogue does not know: datasets with automatic transfer functions."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from datasets.auto_transfer import COLORS, automatic_scenes
from datasets.errors import DataError
from datasets.readers import list_variables, read_volume, suffix_of
from datasets.readers.fields import choose, plain
from datasets.readers.naming import FileName
from datasets.scene import BasicScene, Dataset
from datasets.volume import Volume

MOST_SCENES = 12
"""Of a file with several variables: three of each, fewer where there are more than four variables."""

_log = logging.getLogger(__name__)


def file_dataset(name: str) -> Dataset:
    """The dataset of ``PATH`` or ``PATH:variable=T,step=3,resolution=256``.

    One field has the scenes ``tf1``, ``tf2``... A file of several variables, without a choice, becomes a
    dataset of all of them with the scenes ``T_tf1``...; a log message says which were left out, and why.

    Raises:
        UnknownName: no such variable, or no such key; near matches are listed.
        DataError: the file cannot be used, or none of its variables can be shown.
    """
    asked = FileName.parse(name)
    found = list_variables(asked.path)
    if len(found) > 1 and asked.variable is None:
        return _of_all(asked, [variable.name for variable in found])
    if found:  # a name that the file spells otherwise
        asked = replace(asked, variable=choose(asked.path, found, asked.variable, None, None).name)
    volume = _read(asked, None)
    scenes = automatic_scenes(volume)
    names = tuple(scene.name for scene in scenes)
    several = asked.variable if len(found) > 1 or (found and asked.variable != found[0].name) else None
    return Dataset(
        _name(asked, several),
        f"{asked.path.name}, automatic transfer functions",
        "volume",
        scenes,
        {"all": names} if len(names) > 1 else {},
        {volume.name: lambda: volume},
    )


def safe_name(text: str) -> str:
    """A name for folders, tables and command lines: letters, digits, ``_``, ``-`` and ``.``."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("_.-") or "volume"


def _name(asked: FileName, variable: str | None) -> str:
    """The file's stem and what was chosen, so that tables tell one choice from another."""
    path = asked.path
    parts = [path.name[: len(path.name) - len(suffix_of(path))]]
    parts += [variable] if variable is not None else []
    parts += [f"step{asked.step}"] if asked.step is not None else []
    parts += [f"r{asked.resolution}"] if asked.resolution is not None else []
    return "-".join(safe_name(part) for part in parts)


def _read(asked: FileName, name: str | None) -> Volume:
    return read_volume(asked.path, name, array=asked.variable, step=asked.step, resolution=asked.resolution)


def _of_all(asked: FileName, variables: list[str]) -> Dataset:
    path = asked.path
    scenes: list[BasicScene] = []
    compositions: dict[str, tuple[str, ...]] = {}
    volumes: dict[str, Callable[[], Volume]] = {}
    grids = set()
    left_out: list[str] = []
    each = max(1, min(3, MOST_SCENES // len(variables)))
    for variable in variables:
        if len(scenes) + each > MOST_SCENES:
            left_out.append(f"{variable} (more than {MOST_SCENES} scenes)")
            continue
        key = plain(variable) or "value"
        if key in volumes:
            key = f"{key}_{len(volumes)}"
        one = replace(asked, variable=variable)
        try:
            volume = _read(one, key)
        except DataError as error:
            left_out.append(f"{variable} ({error.reason})")
            first = error
            continue
        made = [_named(scene, key, len(scenes) + i) for i, scene in enumerate(automatic_scenes(volume, each))]
        scenes += made
        # Read again when it is asked for: all variables together may not fit into memory.
        volumes[key] = partial(_read, one, key)
        grids.add((volume.dims, volume.spacing))
        if len(made) > 1:
            compositions[key] = tuple(scene.name for scene in made)
    if not scenes:
        raise first
    if left_out:
        _log.warning("%s: left out: %s. Choose one with %s:variable=NAME", path, "; ".join(left_out), path)
    if len(grids) == 1 and len(scenes) > 1:
        compositions = {"all": tuple(scene.name for scene in scenes), **compositions}
    title = f"{path.name}, {len(volumes)} variables, automatic transfer functions"
    return Dataset(_name(asked, None), title, "volume", tuple(scenes), compositions, volumes)


def _named(scene: BasicScene, variable: str, number: int) -> BasicScene:
    """A scene of one of several variables: its own name, and the next color of the palette."""
    name = f"{variable}_{scene.name}"
    if scene.transfer is None:
        return replace(scene, name=name)
    color = COLORS[number % len(COLORS)]
    bumps = tuple(replace(bump, color=color) for bump in scene.transfer.bumps)
    return replace(scene, name=name, transfer=replace(scene.transfer, name=name, bumps=bumps))
