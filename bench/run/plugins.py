"""Plugin folders of a run store: those that this user's own command line gave for it on this machine.

A store may come from somebody else, so nothing in it decides what is imported. It holds a random id alone.
The folders are in the user's folder of state, under that id: a store that was moved keeps them, and one that
was received, a bundle, or a merged store has none. A folder that has another owner by now is left out.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import uuid
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from platformdirs import user_state_path

from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.registry import Registry

ID = "id"
"""File of a store with its id; bundles and merges leave it behind."""


def plugin_folders(given: Iterable[str], *stores: Path) -> tuple[str, ...]:
    """The plugin folders of a command: those of its command line, or else those that the stores remember.

    Prints a warning for each remembered folder that cannot be used.

    Args:
        given: of the command line.
        stores: folders of run stores, which need not exist.
    """
    if folders := resolved(given):
        return folders
    usable: list[str] = []
    for folder, owner in dict(entry for store in stores for entry in _remembered(store)).items():
        if reason := _obstacle(folder, owner, usable):
            words = (
                f"bench: the plugin folder {folder}, remembered from an earlier run, is left out: {reason}"
            )
            print(f"{words} (--plugins names another)", file=sys.stderr)
        else:
            usable.append(folder)
    return tuple(usable)


def resolved(given: Iterable[str]) -> tuple[str, ...]:
    """Folders as absolute paths."""
    return tuple(str(Path(folder).expanduser().resolve()) for folder in given)


def remember(store: Store, given: Sequence[str]) -> None:
    """Keep the plugin folders of the command line for later commands on a store.

    Folders of earlier runs stay if they can be used beside them. Prints a warning if the user's folder of
    state or the store cannot be written.

    Args:
        store: the run store.
        given: absolute paths.
    """
    if not given:
        return
    folders = list(given)
    for folder, owner in _remembered(store.root):
        if folder not in folders and not _obstacle(folder, owner, folders):
            folders.append(folder)
    entries = [{"path": folder, "owner": Path(folder).stat().st_uid} for folder in folders]
    try:
        if _identity(store.root) is None:
            write_text(store.root / ID, uuid.uuid4().hex + "\n")
        file = _state_file(_identity(store.root) or "")
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_text(file, json.dumps({"store": str(store.root), "folders": entries}, indent=1) + "\n")
    except OSError as error:
        print(f"bench: later commands will need --plugins again: {error}", file=sys.stderr)


def _remembered(store: Path) -> list[tuple[str, int]]:
    """Folders and their owners."""
    identity = _identity(store)
    if identity is None:
        return []
    try:
        facts: dict[str, Any] = json.loads(_state_file(identity).read_text(encoding="utf-8"))
        return [(str(entry["path"]), int(entry["owner"])) for entry in facts["folders"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _obstacle(folder: str, owner: int, others: Sequence[str]) -> str:
    """Why a remembered folder cannot be used beside others; "" if it can."""
    try:
        if Path(folder).stat().st_uid != owner:
            return "it has another owner by now"
        Registry([*others, folder])
    except FileNotFoundError:
        return "it is gone"
    except (OSError, DataError) as error:
        return str(error)
    return ""


def _identity(store: Path) -> str | None:
    try:
        text = (store.expanduser() / ID).read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return None
    return text if re.fullmatch("[0-9a-f]{32}", text) else None


def _state_file(identity: str) -> Path:
    name = hashlib.sha256(identity.encode()).hexdigest()[:32]
    return user_state_path("econgs-bench") / "plugins" / f"{name}.json"
