"""Entries of the catalogue (TOML files) and the places of their data. Imports nothing heavy."""

from __future__ import annotations

import math
import os
import re
import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from econgs_bench.datasets.errors import DataError

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
        host: server of the missing files; "" where they are here or not public.
        size: bytes of its files; None where not known.
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
    host: str
    size: int | None
    where: str


def names() -> list[str]:
    """Names of all entries: procedural ones, further built-in ones, the user's own."""
    return [*built_in(), *own_files()]


@cache
def built_in() -> tuple[str, ...]:
    """Names of the entries that come with the package, procedural ones first."""
    places = sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))
    return tuple(sorted(places, key=lambda name: _built_in(name)["kind"] != "procedural"))


def members(name: str) -> list[str]:
    """Names of the sets that "beetle@64+argon_bubble" joins, without their resolutions."""
    return [part.partition("@")[0] for part in name.split("+")]


def is_joined(name: str) -> bool:
    """Whether a text names several sets of the catalogue, as "beetle+argon_bubble"."""
    parts = members(name)
    return len(parts) > 1 and all(part in names() for part in parts)


def is_procedural(name: str) -> bool:
    """Whether ``NAME`` or ``NAME@RESOLUTION``, or several joined by "+", are built-in volumes of formulas."""
    return all(part in built_in() and _built_in(part)["kind"] == "procedural" for part in members(name))


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
    from econgs_bench.datasets.catalogue.own import read_entry

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
            infos.append(DatasetInfo(name, "", "broken", None, (), (), {}, False, "", None, str(error)))
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


def size_of(table: dict[str, Any], path: str) -> int | None:
    """Bytes of a raw file of an entry by its name, or by the entry's dims and the type in its name."""
    kind = re.search(r"(?:u?int|float)(8|16|32|64)(?![0-9])", path)
    if not path.endswith(".raw") or kind is None:
        return None
    dims = re.search(r"(?<![0-9])([0-9]+)x([0-9]+)x([0-9]+)(?![0-9])", path)
    counts = [int(count) for count in (dims.groups() if dims else table.get("dims", ()))]
    return math.prod(counts) * int(kind[1]) // 8 if counts else None


def public_files(table: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Path in an entry -> table of that file with ``url`` and ``sha512``, for files at a fixed address."""
    return {file["path"]: file for file in reversed(table.get("files", [])) if "url" in file}


def remedy(request: str, table: dict[str, Any], folders: Sequence[Path]) -> str:
    """How to get the files of an entry that a command line names ``request``."""
    searched = ", ".join(str(folder) for folder in folders) or "none"
    files = ", ".join(paths_of(table)[:4])
    text = f"et {ENVIRONMENT} to the folder that holds {files} (searched: {searched})"
    if host := host_of(table, paths_of(table)):
        return f"Run `bench fetch {shlex.quote(request)}` (from {host}), or s{text}"
    return f"S{text}" + (f"; source: {table['acknowledgement']}" if table.get("acknowledgement") else "")


def host_of(table: dict[str, Any], paths: Sequence[str]) -> str:
    """Server of these files of an entry; "" unless all are public."""
    files = public_files(table)
    hosts = [urlsplit(files[path]["url"]).hostname if path in files else None for path in paths]
    return ", ".join(dict.fromkeys(filter(None, hosts))) if all(hosts) else ""


def compositions_of(table: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """Compositions of the entry, and "all"; none for pre-rendered views, which have no joint ground truth."""
    scenes = tuple(scene["name"] for scene in table["scenes"])
    if table["kind"] == "views" or len(scenes) < 2:
        return {}
    compositions = {name: tuple(parts) for name, parts in table.get("compositions", {}).items()}
    return {"all": scenes, **compositions}


def _info(name: str, folders: Sequence[Path]) -> DatasetInfo:
    table = entry(name)
    places = {path: locate(path, folders) for path in paths_of(table)}
    missing = [path for path, at in places.items() if at is None]
    size = None
    if table["kind"] == "procedural":
        nx, ny, nz = table.get("dims", (64, 64, 64))
        dims: tuple[int, int, int] | None = (nx, ny, nz)
        variables = tuple(dict.fromkeys(scene["variable"] for scene in table["scenes"]))
        where = f"built in, at any resolution ({name}@128)"
    else:
        dims = (table["dims"][0], table["dims"][1], table["dims"][2]) if "dims" in table else None
        variables = tuple(file["variable"] for file in table.get("files", []))
        where = str(next(iter(places.values())))
        if missing:
            where = f"missing {', '.join(missing)}. {remedy(name, table, folders)}"
        if table["kind"] == "volume":
            sizes = [at.stat().st_size if at else size_of(table, path) for path, at in places.items()]
            size = None if None in sizes else sum(size or 0 for size in sizes)
    return DatasetInfo(
        name,
        table["title"],
        table["kind"],
        dims,
        variables,
        tuple(scene["name"] for scene in table["scenes"]),
        compositions_of(table),
        not missing,
        host_of(table, missing) if missing else "",
        size,
        where,
    )
