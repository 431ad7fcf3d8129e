"""Rendered views on disk, by a key of all that decides them.

An entry is a folder named by its key: ``entry.json`` and ``images.zst``, one zstd frame per view of
premultiplied 16-bit RGBA (error at most 7.7e-6, far below the 8 bits that any metric sees). It is written
aside and renamed in place, so it is whole or absent; a checksum finds what was damaged later.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scratch import cache_root, new_array
from econgs_bench.datasets.seals import sealed, unsealed
from econgs_bench.datasets.view_files import INDEX, read_views, rounded, write_views

DEFAULT_MAX_BYTES = 20 * 2**30
_SCHEMA = 1
_ABANDONED_AFTER = 3600.0  # seconds without a change: its writer is dead


@dataclass(frozen=True, eq=False)
class CachedViews:
    """Images (n, height, width, 4) float32 premultiplied, and the record stored beside them."""

    images: NDArray[np.float32]
    record: dict[str, Any]


class ViewCache:
    """Views by key, with a size cap.

    Args:
        folder: where entries lie; default ``views`` in :func:`cache_root`.
        max_bytes: after each write, least recently used entries go until the rest fits.
    """

    def __init__(self, folder: Path | None = None, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        self.folder = cache_root() / "views" if folder is None else folder
        self.max_bytes = max_bytes

    def get(self, key: str) -> CachedViews | None:
        """The entry of that key, or None if it is absent or damaged (a damaged one is removed)."""
        entry = self._entry(key)
        if entry is None:
            return None
        try:
            images = read_views(self.folder / key / "images.zst", entry)
        except (OSError, ValueError, KeyError, TypeError):
            self._discard(self.folder / key)
            return None
        self._touch(key)
        return CachedViews(images, dict(entry["record"]))

    def put(self, key: str, images: NDArray[np.float32], record: dict[str, Any]) -> NDArray[np.float32]:
        """Store views; two processes may write the same key.

        Args:
            key: content hash, a plain file name.
            images: (n, height, width, 4), in [0, 1].
            record: what to keep beside them, as plain JSON values.

        Returns:
            The images exactly as :meth:`get` will give them.

        Raises:
            DataError: the folder cannot be written.
        """
        stored = new_array(images.shape, images.dtype)
        for image, place in zip(images, stored, strict=True):
            place[:] = rounded(image)
        aside = self.folder / f".partial-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            aside.mkdir(parents=True)
        except OSError as error:
            raise DataError(
                self.folder, f"cannot be written ({error.strerror})", "Set BENCH_CACHE to another folder"
            ) from error
        try:
            index = write_views(aside / "images.zst", stored)
            entry = {"schema": _SCHEMA, **index, "record": record}
            (aside / "entry.json").write_text(sealed(json.dumps(entry, indent=1)), encoding="utf-8")
            self._place(aside, key)
        finally:
            shutil.rmtree(aside, ignore_errors=True)
        self.prune(self.max_bytes, keep=key)
        return stored

    def link(self, key: str, file: Path) -> dict[str, Any] | None:
        """Give an entry's pictures a second name, which stays when the entry goes.

        Returns:
            What :func:`.datasets.view_files.read_views` needs, or None if there is no entry or no such link.
        """
        entry = self._entry(key)
        if entry is None:
            return None
        try:
            os.link(self.folder / key / "images.zst", file)
        except OSError:  # another file system
            return None
        return {name: entry[name] for name in INDEX if name in entry}

    def prune(self, max_bytes: int, keep: str = "") -> int:
        """Remove least recently used entries until the rest takes at most ``max_bytes``.

        What dead writers left goes too; the entry ``keep`` stays.

        Returns:
            Bytes freed.
        """
        freed, entries = 0, []
        for folder, used, size in self._measured():
            if not folder.name.startswith("."):
                entries.append((used, size, folder))
            elif time.time() - used > _ABANDONED_AFTER:
                shutil.rmtree(folder, ignore_errors=True)
                freed += size
        total = sum(size for _, size, _ in entries)
        for _, size, folder in sorted(entries, key=lambda e: (e[0], e[2].name)):
            if total <= max_bytes:
                break
            if folder.name != keep:
                self._discard(folder)
                total -= size
                freed += size
        return freed

    def size(self) -> int:
        """Bytes of all entries."""
        return sum(size for _, _, size in self._measured())

    def _measured(self) -> Iterator[tuple[Path, float, int]]:
        """Each folder with its time of use and its bytes."""
        for folder in self.folder.iterdir() if self.folder.is_dir() else ():
            with suppress(OSError):  # no folder, or another process removed it meanwhile
                yield folder, folder.stat().st_mtime, sum(file.stat().st_size for file in folder.iterdir())

    def _entry(self, key: str) -> dict[str, Any] | None:
        folder = self.folder / key
        try:
            entry = json_of(unsealed((folder / "entry.json").read_text(encoding="utf-8")), finite=False)
            size = (folder / "images.zst").stat().st_size
            whole = entry["schema"] == _SCHEMA and size == sum(entry["frames"])
            if not (whole and isinstance(entry["record"], dict)):
                raise ValueError("schema or size")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError):
            self._discard(folder)
            return None
        return dict(entry)

    def _place(self, aside: Path, key: str) -> None:
        for _ in range(3):
            try:
                os.rename(aside, self.folder / key)
            except OSError:
                if self._entry(key) is not None:
                    return  # another process was first, with the same content
                self._discard(self.folder / key)
            else:
                return
        raise OSError(f"{self.folder / key}: cannot be put in place")

    def _discard(self, folder: Path) -> None:
        """Take a folder out of sight first: a reader sees an entry whole or not at all."""
        grave = self.folder / f".partial-removed-{uuid.uuid4().hex[:8]}"
        try:
            os.rename(folder, grave)
        except OSError:
            return
        shutil.rmtree(grave, ignore_errors=True)

    def _touch(self, key: str) -> None:
        with suppress(OSError):  # a read-only cache, or pruned meanwhile
            os.utime(self.folder / key)
