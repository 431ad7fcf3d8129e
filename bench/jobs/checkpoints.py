"""Checkpoints on disk: safetensors for arrays, JSON for the rest; no pickle."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from econgs_bench.bench.store.store import write_text
from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError, text_of
from econgs_bench.datasets.seals import checksum, sealed, unsealed
from econgs_bench.methods.interface import Checkpoint

VERSION = 2
"""Raised when a checkpoint of an earlier version could be misread."""
_META, _ARRAYS = "checkpoint.json", "arrays.safetensors"
_MOST_VALUES = 10_000_000
"""Values of the first of these files; the curve of a long fit has thousands."""


class Damaged(DataError):
    """A checkpoint that is not as it was written."""


def write_checkpoint(folder: Path, checkpoint: Checkpoint, harness: dict[str, Any]) -> None:
    """Write ``folder/<iteration>/`` aside, rename it in place, then drop the older ones.

    Args:
        folder: holds the checkpoints of one fit.
        checkpoint: state of the method.
        harness: state of the harness (clock, curve); JSON values.
    """
    target = folder / f"{checkpoint.iteration:09d}"
    if target.exists():  # the same state, stored whole
        return
    aside = folder / f".{target.name}"
    shutil.rmtree(aside, ignore_errors=True)
    folder.mkdir(exist_ok=True)  # not its parents: a store that was removed stays away
    aside.mkdir()
    if checkpoint.arrays:
        from safetensors.torch import save_file

        arrays = {name: a.detach().cpu().contiguous().clone() for name, a in checkpoint.arrays.items()}
        save_file(arrays, aside / _ARRAYS)
    meta = {
        "version": VERSION,
        "iteration": checkpoint.iteration,
        "scalars": checkpoint.scalars,
        "harness": harness,
        "arrays": checksum(aside / _ARRAYS) if checkpoint.arrays else None,
    }
    write_text(aside / _META, sealed(json.dumps(meta)))
    os.rename(aside, target)
    for older in folder.iterdir():
        if older != target:
            shutil.rmtree(older, ignore_errors=True)


def read_checkpoint(folder: Path) -> tuple[Checkpoint, dict[str, Any]] | None:
    """The newest checkpoint under a folder and the state of the harness; None if there is none.

    Raises:
        DataError: an earlier version wrote it.
        Damaged: it is not as it was written.
    """
    newest = max((path.parent for path in folder.glob(f"[0-9]*/{_META}")), default=None)
    if newest is None:
        return None
    try:
        return _read(newest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"this checkpoint is damaged ({type(error).__name__}: {text_of(error)})"
        remedy = f"Delete {folder.parent}, and bench run --retry makes it again"
        raise Damaged(newest, reason, remedy) from error


def _read(folder: Path) -> tuple[Checkpoint, dict[str, Any]]:
    meta = json_of(unsealed((folder / _META).read_text(encoding="utf-8")), _MOST_VALUES, finite=False)
    if meta.get("version") != VERSION:
        raise DataError(folder, "an earlier version wrote this checkpoint", "Run into a new store (--out)")
    arrays, file = {}, folder / _ARRAYS
    known = meta.get("arrays", "")  # "" of stores before there was a checksum
    if known is not None and (known or file.is_file()):
        if known and checksum(file) != known:
            raise ValueError("the checksum of its arrays differs")
        from safetensors.torch import load_file

        arrays = load_file(file)
    return Checkpoint(meta["iteration"], arrays, meta["scalars"]), meta["harness"]
