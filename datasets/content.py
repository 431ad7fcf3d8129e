"""Content hashes of scenes: equal where the pictures are, whatever the names of files and folders."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.datasets.ground_truth.model import MODEL_VERSION
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.render_views import volume_digest
from econgs_bench.datasets.scene import Dataset

_IMAGES = {".png", ".json", ".ply"}


def fingerprint(dataset: Dataset, scene_name: str) -> str:
    """Hash of all that decides the pictures of a scene: its definition and its data.

    Raises:
        DataError: the data cannot be read.
    """
    scene = dataset.scene(scene_name)
    identity: dict[str, Any] = {
        "scene": _plain({k: v for k, v in asdict(scene).items() if k != "views_folder"})
    }
    if scene.views_folder is not None:
        identity["files"] = _folder_hash(scene.views_folder)
    else:
        identity["volume"] = volume_digest(dataset.volume(scene.variable))
        identity["optical model"] = MODEL_VERSION
        if dataset.frame is not None:  # of the catalogue's datasets no view, and so no hash, depends on one
            identity["frame"] = asdict(dataset.frame)
    return hash_of(identity)


def content(dataset: Dataset, scenes: Sequence[str], *, composed: bool) -> str:
    """Content hash of a basic scene, or of the composition of some.

    Raises:
        DataError: no such scene, or its data cannot be read.
    """
    hashes = [fingerprint(dataset, scene) for scene in scenes]
    return composition_hash(hashes) if composed else hashes[0]


def composition_hash(scenes: Sequence[str]) -> str:
    """Content hash of a composition, from those of its scenes."""
    return hash_of({"composition": list(scenes)})


def _folder_hash(folder: Path) -> str:
    from econgs_bench.datasets.posed_images import files

    own = (p for p in folder.rglob("*") if p.suffix.lower() in _IMAGES and p.is_file())
    digest = hashlib.sha256()
    for file in sorted({Path(os.path.normpath(path)) for path in (*own, *files(folder))}):
        digest.update(os.fsencode(os.path.relpath(file, folder)) + b"\0")
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """Dataclass contents as JSON values."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
