"""The run store: a folder per job, written aside and renamed in place.

    RUNS/store.json  jobs/<kind>-<key>/  partial/<kind>-<key>/  locks/  tables/*.parquet  damaged/

A record is either whole or absent: ``record.json`` is written last (temporary file, fsync, rename)
and its folder then moves from ``partial/`` to ``jobs/`` by one rename. A record that somebody has damaged
counts as none: it is in no table, its job runs again, and its folder is kept in ``damaged/``. So does one
that is not that of its folder's job.

A store may come from somebody else. So no path is built from what a record says but from names of jobs,
which :mod:`.bench.store.records` checks, and a store that holds a symbolic link is not opened.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pydantic import ValidationError

from econgs_bench.bench.store.leases import Lease
from econgs_bench.bench.store.records import KINDS, READABLE, SCHEMA, Record, record_of
from econgs_bench.datasets.bounded import check_finite, json_of, number_of_values
from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.datasets.seals import sealed, unsealed

LONGEST = 32 * 2**20
"""Bytes of a record that is read: a hundred times those of any committed one."""
MOST_VALUES = 4_000_000
"""Values of a record that is read: two hundred times those of any committed one."""
_OUTPUTS = {"views": "views.json", "fit": "checkpoint", "encode": "model"}
"""Kind of a job -> what other jobs read of its folder; all else is in its record."""
_HEX = "[0-9a-f]" * 32
"""How the name of a temporary file of :func:`write_text` ends."""


class Store:
    """A run store on disk.

    Args:
        root: its folder.
        create: create it if it does not exist.
        checked: whether the process that started this one has looked for symbolic links.

    Attributes:
        damaged: folder in ``jobs/`` -> why its record cannot be read, as far as records were looked at.

    Raises:
        DataError: the folder is no run store, or one of another schema version, or holds symbolic links.
    """

    def __init__(self, root: Path, *, create: bool = False, checked: bool = False) -> None:
        self.root = root.expanduser().resolve()
        self._cache: dict[str, tuple[int, Record]] = {}
        self.damaged: dict[str, str] = {}
        marker = self.root / "store.json"
        # Looked up before the marker: another run may be writing that, and its folders after it.
        foreign = self.root.is_file() or any(
            path.name != "locks" and not path.name.startswith(f".{marker.name}.")
            for path in self.root.glob("*")
        )
        if not marker.is_file():
            if not create:
                raise DataError(root, "no run store", "Give the folder that `bench run --out` wrote")
            if foreign:
                raise DataError(root, "neither empty nor a run store", "Give --out a new folder")
            try:
                self.root.mkdir(parents=True, exist_ok=True)
                write_text(marker, json.dumps({"schema_version": SCHEMA}) + "\n")
            except OSError as error:
                raise DataError(
                    root, f"cannot be written ({error.strerror})", "Give --out another folder"
                ) from error
        if not checked:
            check_files(self.root)
        try:
            version = json_of(marker.read_bytes(), most=1000)["schema_version"]
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                marker, "cannot be read as a run store's marker", "Restore it or start anew"
            ) from error
        if version not in READABLE:
            raise DataError(
                root,
                f"has schema version {version}, this program writes {SCHEMA}",
                "Use a new folder for new runs",
            )
        if create and version != SCHEMA:
            write_text(marker, json.dumps({"schema_version": SCHEMA}) + "\n")
        folders = [self.root / name for name in ("jobs", "partial", "locks", "tables")]
        self.jobs, self.partial, self.locks, self.tables = folders
        for folder in folders:
            folder.mkdir(exist_ok=True)

    def check(self) -> None:
        """Check that the store is still in place.

        Raises:
            DataError: it was removed or moved since it was opened.
        """
        if not all(path.exists() for path in (self.root / "store.json", self.jobs, self.partial, self.locks)):
            raise DataError(
                self.root,
                "the run store was removed or moved during the run",
                "Put it back and run again: finished jobs count as done",
            )

    def lease(self, name: str) -> Lease:
        """The lease of a job or of "tables", not held at first."""
        return Lease(self.locks / name)

    def record(self, job: str) -> Record | None:
        """The record of a finished job; None without one, or if it is damaged."""
        path = self.jobs / job / "record.json"
        self.damaged.pop(job, None)
        try:
            stamp = path.stat().st_mtime_ns
            cached = self._cache.get(job)
            if cached is None or cached[0] != stamp:
                cached = self._cache[job] = (stamp, read_record(path))
            return cached[1]
        except (FileNotFoundError, NotADirectoryError):
            pass
        except DataError as error:
            self.damaged[job] = error.reason
        self._cache.pop(job, None)
        return None

    def records(self) -> Iterator[Record]:
        """All finished jobs, by id."""
        for folder in sorted(self.jobs.iterdir()):
            record = self.record(folder.name)
            if record is not None:
                yield record

    def holds_files_of(self, record: Record) -> bool:
        """Whether the output that other jobs read is here; bundles bring records, and models if asked for."""
        name = _OUTPUTS.get(record.job.kind)
        return name is None or (self.jobs / record.job.id / name).exists()

    def finish(self, record: Record, folder: Path | None = None, lease: Lease | None = None) -> None:
        """Write a record into its partial folder and rename that folder into ``jobs/``.

        Args:
            record: of the job.
            folder: of its files; default: its partial folder.
            lease: of the job, which the caller holds.

        Raises:
            Lost: another process has taken the lease over; nothing was put in place.
        """
        folder = folder or self.partial / record.job.id
        if lease is not None:
            lease.renew()
        folder.mkdir(exist_ok=True)
        for temporary in folder.rglob(f".*.{_HEX}"):  # of an attempt that was killed within write_text
            temporary.unlink(missing_ok=True)
        for entry in _neither_files_nor_folders(folder):  # of a method; the store could not be opened again
            os.unlink(entry.path)
        write_text(folder / "record.json", sealed(record.model_dump_json(indent=1) + "\n"))
        self.put_in_place(folder, record.job.id, lease)

    def put_in_place(self, folder: Path, job: str, lease: Lease | None = None) -> None:
        """Rename a folder with a whole record into ``jobs/``; it replaces an older one.

        Raises:
            Lost: another process has taken the lease over; nothing was put in place.
        """
        if lease is not None:
            lease.renew()
        target = self.jobs / job
        if target.exists() and self.record(job) is None:
            self.set_aside(job)
        if target.exists():
            aside = self.partial / f"old-{uuid.uuid4().hex}"
            os.rename(target, aside)
            os.rename(folder, target)
            shutil.rmtree(aside, ignore_errors=True)
        else:
            os.rename(folder, target)
        _sync(self.jobs)

    def reopen(self, record: Record) -> None:
        """Move a failed job back to ``partial/`` for another attempt.

        Its checkpoint is kept if time, memory or a signal ended the job, and dropped if the method failed.
        """
        source, target = self.jobs / record.job.id, self.partial / record.job.id
        shutil.rmtree(target, ignore_errors=True)
        os.rename(source, target)
        (target / "record.json").unlink(missing_ok=True)
        if record.status not in ("timeout", "oom") and not (record.reason or "").startswith("killed"):
            shutil.rmtree(target)

    def set_aside(self, job: str) -> Path:
        """Move what is in ``jobs/`` under this name to ``damaged/``; returns where it is now."""
        target = self.root / "damaged" / f"{job}-{uuid.uuid4().hex[:8]}"
        target.parent.mkdir(exist_ok=True)
        os.rename(self.jobs / job, target)
        return target

    def sweep(self) -> None:
        """Remove folders that a killed process set aside."""
        for leftover in self.partial.glob("old-*"):
            shutil.rmtree(leftover, ignore_errors=True)


def read_record(path: Path) -> Record:
    """Read and check the record in the folder of a job.

    Raises:
        DataError: it is no record of this schema, or that of another job.
    """
    try:
        if (size := path.stat().st_size) > LONGEST:
            raise ValueError(f"{size} bytes, more than any has")
        text = unsealed(path.read_text(encoding="utf-8"))
        if (values := number_of_values(text)) > MOST_VALUES:
            raise ValueError(f"{values} values, more than any has")
        check_finite(text)
        kind = path.parent.name.partition("-")[0]
        if kind not in KINDS:
            raise ValueError("its folder has no name of a job")
        record = record_of(text, kind)
        record = record.job.migrated(record)
        if record.job.id != path.parent.name:
            raise ValueError(f"it is that of {record.job.id}")
        return record
    except ValueError as error:
        first = str(error)
        if isinstance(error, ValidationError):
            wrong = error.errors()[0]
            first = ": ".join(map(str, [*wrong["loc"], wrong["msg"]]))
        raise DataError(
            path, f"not a whole record ({first})", "`bench repair` sets it aside; the job then runs again"
        ) from error


def check_files(root: Path) -> None:
    """Check that a folder holds files and folders alone.

    A link may lead a program that reads, copies, writes or deletes out of the folder, and a pipe never ends.
    What another process removes meanwhile is none of it.

    Raises:
        DataError: it holds a symbolic link, pipe, socket or device.
    """
    for entry in _neither_files_nor_folders(root):
        kind = "a symbolic link" if entry.is_symlink() else "a pipe, socket or device"
        where = printable(os.path.relpath(entry.path, root))
        raise DataError(
            root,
            f"holds {kind}, {where!r}, and a run store consists of files and folders",
            "Remove it, or put in its place what it leads to, if you trust that",
        )


def folder_bytes(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _neither_files_nor_folders(root: Path) -> Iterator[os.DirEntry[str]]:
    folders = [str(root)]
    while folders:
        with suppress(FileNotFoundError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif not entry.is_file(follow_symlinks=False) and os.path.lexists(entry.path):
                    yield entry


@contextmanager
def aside_of(path: Path) -> Iterator[Path]:
    """A free, hidden name beside a file or folder, to be written there and renamed when it is whole.

    What has the name at the end, whole or not, is removed.
    """
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        yield aside
    finally:
        if aside.is_dir():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file atomically: after a crash or power cut it is whole or as before."""
    with aside_of(path) as aside:
        with aside.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Flush a rename to disk (on POSIX)."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
