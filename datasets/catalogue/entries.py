"""What the catalogue's TOML files say, and where their data lie. Imports nothing heavy."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ENVIRONMENT = "BENCH_DATA"


@dataclass(frozen=True)
class DatasetInfo:
    """What ``bench list datasets`` tells of a dataset.

    Attributes:
        name: identifier for ``--dataset``.
        title: one line for people.
        kind: "procedural", "volume" or "views".
        dims: samples along x, y, z; None for "views".
        variables: names of its volumes; empty for "views".
        scenes: names of its basic scenes.
        compositions: name -> basic scenes shown together.
        available: its files are there (always, for procedural ones).
        where: the folder or "built in"; if not available, what is missing and how to get it.
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
    """Names of all entries, procedural ones first."""
    found = sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))
    return sorted(found, key=lambda name: entry(name)["kind"] != "procedural")


@cache
def entry(name: str) -> dict[str, Any]:
    """The TOML of one entry."""
    return tomllib.loads((Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8"))


def list_datasets(data_dirs: Sequence[Path | str] | None = None) -> list[DatasetInfo]:
    """Every entry of the catalogue, with where its data lie or how to get them."""
    return [_info(name, data_folders(data_dirs)) for name in names()]


def data_folders(data_dirs: Sequence[Path | str] | None = None) -> list[Path]:
    """The folders searched, in order: those given, else ``BENCH_DATA`` and the user's data folder."""
    if data_dirs is not None:
        return [Path(folder).expanduser() for folder in data_dirs]
    said = [Path(part).expanduser() for part in os.environ.get(ENVIRONMENT, "").split(os.pathsep) if part]
    return [*said, user_folder()]


def user_folder() -> Path:
    """Where downloads go, and the last folder searched."""
    from platformdirs import user_data_path

    return user_data_path("econgs-bench", appauthor=False)


def locate(relative: str, folders: Sequence[Path]) -> Path | None:
    """The first file (as such, or gzipped) or folder of that relative path."""
    for folder in folders:
        for path in (folder / relative, folder / f"{relative}.gz"):
            if path.exists():
                return path
    return None


def paths_of(said: dict[str, Any]) -> list[str]:
    """Relative paths of what an entry needs."""
    if said["kind"] == "views":
        return [f"{said['folder']}/{scene['name']}/transforms_train.json" for scene in said["scenes"]]
    return list(dict.fromkeys(file["path"] for file in said.get("files", [])))


def remedy(said: dict[str, Any], folders: Sequence[Path]) -> str:
    """How to get the files of an entry."""
    searched = ", ".join(str(folder) for folder in folders) or "none"
    wanted = ", ".join(paths_of(said)[:4])
    text = f"Set {ENVIRONMENT} to the folder that holds {wanted} (searched: {searched})"
    for file in said.get("files", []):
        if "url" in file:
            text += f"; public file: {file['url']} (sha512 {file['sha512']})"
    if not any("url" in file for file in said.get("files", [])):
        text += f"; source: {said['acknowledgement']}"
    return text


def compositions_of(said: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """Those named in the entry, and "all"; none where no ground truth can be rendered."""
    scenes = tuple(scene["name"] for scene in said["scenes"])
    if said["kind"] == "views" or len(scenes) < 2:
        return {}
    named = {name: tuple(parts) for name, parts in said.get("compositions", {}).items()}
    return {"all": scenes, **named}


def _info(name: str, folders: Sequence[Path]) -> DatasetInfo:
    said = entry(name)
    found = [(path, locate(path, folders)) for path in paths_of(said)]
    missing = [path for path, at in found if at is None]
    if said["kind"] == "procedural":
        nx, ny, nz = said.get("dims", (64, 64, 64))
        dims: tuple[int, int, int] | None = (nx, ny, nz)
        variables = tuple(dict.fromkeys(scene["variable"] for scene in said["scenes"]))
        where = f"built in, at any resolution ({name}@128)"
    else:
        dims = (said["dims"][0], said["dims"][1], said["dims"][2]) if "dims" in said else None
        variables = tuple(file["variable"] for file in said.get("files", []))
        where = f"missing {', '.join(missing)}. {remedy(said, folders)}" if missing else str(found[0][1])
    scenes = tuple(scene["name"] for scene in said["scenes"])
    compositions = compositions_of(said)
    return DatasetInfo(
        name, said["title"], said["kind"], dims, variables, scenes, compositions, not missing, where
    )
