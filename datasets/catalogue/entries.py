"""Entries of the catalogue (TOML files) and the places of their data. Imports nothing heavy."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from datasets.errors import DataError

ENVIRONMENT = "BENCH_DATA"
OWN_ENVIRONMENT = "BENCH_CATALOGUE"
"""Folders with entries of the user's own; default: ``catalogue`` in the user's data folder."""


@dataclass(frozen=True)
class DatasetInfo:
    """One dataset of ``bench list datasets``.

    Attributes:
        name: identifier for ``--dataset``.
        title: one line for people.
        kind: "procedural", "volume" or "views"; "broken" for an entry of the user's that cannot be used.
        dims: samples along x, y, z; None for "views".
        variables: names of its volumes; empty for "views".
        scenes: names of its basic scenes.
        compositions: name -> basic scenes rendered together.
        available: whether its files exist (always, for procedural ones).
        where: the folder or "built in"; for an unavailable one, the missing files and their source.
    """

    name: str
    title: str
    kind: str
    dims: tuple[int, int, int] | None
    variables: tuple[str, ...]
    scenes: tuple[str, ...]
    compositions: dict[str, tuple[str, ...]]
    available: bool
    where: str


def names() -> list[str]:
    """Names of all entries: procedural ones, further built-in ones, the user's own."""
    return [*built_in(), *own_files()]


@cache
def built_in() -> tuple[str, ...]:
    """Names of the entries that come with the package, procedural ones first."""
    places = sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))
    return tuple(sorted(places, key=lambda name: _built_in(name)["kind"] != "procedural"))


def own_files() -> dict[str, Path]:
    """Name -> file of the user's own entries. A name of the package's gets "-own" appended."""
    parts = filter(None, os.environ.get(OWN_ENVIRONMENT, "").split(os.pathsep))
    folders = [Path(part).expanduser() for part in parts] or [user_folder() / "catalogue"]
    files: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.glob("*.toml")):
            files.setdefault(own_name(path.stem), path.resolve())
    return files


def own_name(name: str) -> str:
    """The name of a dataset from a file, which is never one of the package's."""
    return f"{name}-own" if name in built_in() else name


def entry(name: str) -> dict[str, Any]:
    """The TOML of one entry.

    Raises:
        DataError: an entry of the user's cannot be used.
    """
    if name in built_in():
        return _built_in(name)
    from datasets.catalogue.own import read_entry

    return read_entry(own_files()[name])


@cache
def _built_in(name: str) -> dict[str, Any]:
    return tomllib.loads((Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8"))


def list_datasets(data_dirs: Sequence[Path | str] | None = None) -> list[DatasetInfo]:
    """Every entry of the catalogue, with the place or the source of its data."""
    infos = []
    for name in names():
        try:
            infos.append(_info(name, folders_of(name, data_dirs)))
        except DataError as error:  # of the user's entries; others go on
            infos.append(DatasetInfo(name, "", "broken", None, (), (), {}, False, str(error)))
    return infos


def folders_of(name: str, data_dirs: Sequence[Path | str] | None = None) -> list[Path]:
    """Folders to search for the files of an entry: first that of the user's own, if it is one."""
    own = own_files().get(name)
    return [*([own.parent] if own else []), *data_folders(data_dirs)]


def data_folders(data_dirs: Sequence[Path | str] | None = None) -> list[Path]:
    """Folders to search, in order: the arguments, else ``BENCH_DATA`` and the user's data folder."""
    if data_dirs is not None:
        return [Path(folder).expanduser() for folder in data_dirs]
    table = [Path(part).expanduser() for part in os.environ.get(ENVIRONMENT, "").split(os.pathsep) if part]
    return [*table, user_folder()]


def user_folder() -> Path:
    """Folder for downloads, the last one of a search."""
    from platformdirs import user_data_path

    return user_data_path("econgs-bench", appauthor=False)


def locate(relative: str, folders: Sequence[Path]) -> Path | None:
    """The first file (as such, or gzipped) or folder of that relative path."""
    for folder in folders:
        for path in (folder / relative, folder / f"{relative}.gz"):
            if path.exists():
                return path
    return None


def paths_of(table: dict[str, Any]) -> list[str]:
    """Relative paths of an entry's files."""
    if table["kind"] == "views":
        return [f"{table['folder']}/{scene['name']}/transforms_train.json" for scene in table["scenes"]]
    return list(dict.fromkeys(file["path"] for file in table.get("files", [])))


def remedy(table: dict[str, Any], folders: Sequence[Path]) -> str:
    """How to get the files of an entry."""
    searched = ", ".join(str(folder) for folder in folders) or "none"
    files = ", ".join(paths_of(table)[:4])
    text = f"Set {ENVIRONMENT} to the folder that holds {files} (searched: {searched})"
    for file in table.get("files", []):
        if "url" in file:
            text += f"; public file: {file['url']} (sha512 {file['sha512']})"
    if not any("url" in file for file in table.get("files", [])):
        text += f"; source: {table['acknowledgement']}" if table.get("acknowledgement") else ""
    return text


def compositions_of(table: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """Compositions of the entry, and "all"; none for pre-rendered views, which have no joint ground truth."""
    scenes = tuple(scene["name"] for scene in table["scenes"])
    if table["kind"] == "views" or len(scenes) < 2:
        return {}
    compositions = {name: tuple(parts) for name, parts in table.get("compositions", {}).items()}
    return {"all": scenes, **compositions}


def _info(name: str, folders: Sequence[Path]) -> DatasetInfo:
    table = entry(name)
    places = [(path, locate(path, folders)) for path in paths_of(table)]
    missing = [path for path, at in places if at is None]
    if table["kind"] == "procedural":
        nx, ny, nz = table.get("dims", (64, 64, 64))
        dims: tuple[int, int, int] | None = (nx, ny, nz)
        variables = tuple(dict.fromkeys(scene["variable"] for scene in table["scenes"]))
        where = f"built in, at any resolution ({name}@128)"
    else:
        dims = (table["dims"][0], table["dims"][1], table["dims"][2]) if "dims" in table else None
        variables = tuple(file["variable"] for file in table.get("files", []))
        where = f"missing {', '.join(missing)}. {remedy(table, folders)}" if missing else str(places[0][1])
    scenes = tuple(scene["name"] for scene in table["scenes"])
    compositions = compositions_of(table)
    return DatasetInfo(
        name, table["title"], table["kind"], dims, variables, scenes, compositions, not missing, where
    )
