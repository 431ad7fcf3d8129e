"""Submission bundles: the records, tables and (optionally) models of a run store in one verifiable file.

A bundle is a zip of a run store without its pictures, so that it can be unpacked and reported on, with

    bundle.json     format, environments, and SHA-256 and length of every other file
    tables/*.csv    the documented tables, which must follow from the records

A name that ends with .xz is of that zip, compressed as a whole: a third of the bytes, as records are alike.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import lzma
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.results.rungs import FILE, ladders_of
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.results.verification import Evidence, absences, contradictions
from econgs_bench.bench.store.records import SCHEMA, Provenance, Record
from econgs_bench.bench.store.store import LONGEST, Store, aside_of, folder_bytes, read_record
from econgs_bench.bench.suites.ladders import Ladder
from econgs_bench.datasets.bounded import (
    decompress_xz,
    json_of,
    number_of_values,
    opened,
    room,
    values_room,
)
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.seals import SEALED_SINCE, is_sealed
from econgs_bench.reports.schema import joined
from econgs_bench.reports.tables.documents import to_csv

MANIFEST = "bundle.json"
FORMAT = 1
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, EOFError, struct.error, ValueError, RuntimeError, OSError,
    ArithmeticError,
)  # fmt: skip
"""What reading a damaged zip raises (encrypted: RuntimeError, of which NotImplementedError is one), and what
figures beyond all ranges do."""
_REVISED = {"scenes_together"}
"""Columns that follow from the records by another rule than when older bundles were written."""
_LONG = {"features", "losses", "scenes", "views", "rung_views"}
"""Tables that take more room than all others and that nobody reads as CSV; records hold them too."""
_PIECE = 2**20
_XZ = b"\xfd7zXZ\0"


def write_bundle(store: Store, out: Path, *, models: bool = False) -> int:
    """Write a bundle atomically.

    Args:
        store: the run store.
        out: path of the zip file, or of one in xz.
        models: include the encoded models.

    Returns:
        Number of records in the bundle.

    Raises:
        DataError: the store has no record.
    """
    records = list(store.records())
    if not records:
        raise DataError(store.root, "holds no finished job", "Run a suite first")
    files: dict[str, dict[str, Any]] = {}
    out.parent.mkdir(parents=True, exist_ok=True)
    with aside_of(out) as aside:
        with _written(aside, xz=out.suffix == ".xz") as archive:
            for name, data in _contents(store, records, models):
                archive.writestr(name, data)
                files[name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
            manifest = {
                "format": FORMAT,
                "schema_version": SCHEMA,
                "environments": _environments(records),
                "files": files,
            }
            archive.writestr(MANIFEST, json.dumps(manifest, indent=1) + "\n")
        os.replace(aside, out)
    return len(records)


@contextmanager
def _written(path: Path, *, xz: bool) -> Iterator[zipfile.ZipFile]:
    if xz:
        with lzma.open(path, "wb", preset=9) as file, zipfile.ZipFile(file, "w") as archive:
            yield archive
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            yield archive


@contextmanager
def zip_of(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip file of a bundle, unpacked aside if it is in xz.

    Raises:
        OSError, ValueError, zipfile.BadZipFile: the file cannot be read, or is damaged.
    """
    with ExitStack() as stack:
        file: IO[bytes] = stack.enter_context(path.open("rb"))
        xz = file.read(len(_XZ)) == _XZ
        file.seek(0)
        if xz:
            packed, file = file, stack.enter_context(tempfile.TemporaryFile())
            decompress_xz(packed, file, room(path.stat().st_size))
        yield stack.enter_context(zipfile.ZipFile(file))


def _contents(store: Store, records: list[Record], models: bool) -> Iterator[tuple[str, bytes]]:
    yield "store.json", (store.root / "store.json").read_bytes()
    for record in records:
        folder = store.jobs / record.job.id
        yield f"jobs/{record.job.id}/record.json", (folder / "record.json").read_bytes()
        if models and record.job.kind == "encode" and record.ok:
            for path in sorted((folder / "model").rglob("*")):
                if path.is_file():
                    yield f"jobs/{record.job.id}/{path.relative_to(folder).as_posix()}", path.read_bytes()
    ladders = ladders_of(store.root)
    if ladders:
        yield FILE, (store.root / FILE).read_bytes()
    for name, table in stored_tables(records, ladders=ladders).items():
        if name not in _LONG and len(table):
            yield f"tables/{name}.csv", to_csv(table).encode()


def _environments(records: list[Record]) -> list[dict[str, Any]]:
    """The distinct environments (machine and versions) of the records."""
    return [json.loads(text) for text in sorted(_distinct(record.provenance for record in records))]


@dataclass(frozen=True)
class Verdict:
    """What became of the checks of a bundle.

    Attributes:
        problems: one line for each thing that does not hold; empty for a valid bundle.
        notes: what could not be checked.
    """

    problems: list[str]
    notes: list[str] = field(default_factory=list)


def verify_bundle(path: Path) -> list[str]:
    """What does not hold in a bundle; empty for a valid one. Raises as :func:`verdict`."""
    return verdict(path).problems


def verdict(path: Path) -> Verdict:
    """Verify a bundle.

    Every file is there with its hash and none besides; records are whole and their jobs' names follow from
    what they say they ran; records contradict neither themselves nor each other
    (:mod:`.bench.results.verification`); environments and tables follow from the records; models have the
    bytes that were measured.

    Raises:
        DataError: the file is no bundle of this format.
    """
    with tempfile.TemporaryDirectory() as folder:
        return unpack(path, Path(folder))


def unpack(path: Path, folder: Path) -> Verdict:
    """Into a folder, file by file, as long as the files themselves hold; as :func:`verdict`.

    Memory and time are bounded by the size of the bundle: its files may have :func:`~.datasets.bounded.room`
    bytes together, and its records :func:`~.datasets.bounded.values_room` values.
    """
    try:
        size = path.stat().st_size
        with zip_of(path) as archive:
            manifest = _manifest(archive, path, size)
            problems = _extract(archive, manifest["files"], folder)
            return Verdict(problems) if problems else _check_store(folder, manifest, values_room(size))
    except FileNotFoundError:
        raise DataError(path, "no such file", "Name a file that `bench bundle` wrote") from None
    except _DAMAGE as error:
        raise DataError(path, f"cannot be read as a bundle ({error})", "Get it anew") from error


@contextmanager
def unpacked(path: Path) -> Iterator[Store]:
    """A bundle as a run store, for as long as the context lasts.

    Raises:
        DataError: the file is no bundle, or not all of it holds.
    """
    with tempfile.TemporaryDirectory() as folder:
        if problems := unpack(path, Path(folder)).problems:
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            raise DataError(path, f"does not hold: {problems[0]}{more}", "`bench verify` lists what is wrong")
        yield Store(Path(folder))


def _manifest(archive: zipfile.ZipFile, path: Path, size: int) -> dict[str, Any]:
    try:
        if (length := archive.getinfo(MANIFEST).file_size) > LONGEST:
            raise ValueError(f"{length} bytes, more than any has")
        manifest: dict[str, Any] = json_of(opened(archive, MANIFEST).read(), values_room(size))
        form, files = manifest["format"], manifest["files"]
        lengths = [int(entry["bytes"]) for entry in files.values()]
        names = [str(entry["sha256"]) for entry in files.values()]
        manifest["environments"] = [
            Provenance.model_validate({**one, "source": None, "threads": 1})
            for one in manifest["environments"]
        ]
        manifest["schema_version"] = int(manifest["schema_version"])
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise DataError(path, f"is no bundle ({MANIFEST}: {error})", "Make it with `bench bundle`") from error
    if form != FORMAT:
        raise DataError(path, f"is a bundle of format {form}, not {FORMAT}", "Use the program that wrote it")
    if sum(lengths) > room(size) or min(lengths, default=0) < 0 or len(names) > 1_000_000:
        reason = f"says that its files have {sum(lengths)} bytes, and {room(size)} are the most for its size"
        raise DataError(path, reason, "Get it anew, or bundle parts of the run store")
    return manifest


def _extract(archive: zipfile.ZipFile, files: dict[str, Any], folder: Path) -> list[str]:
    """Write the files of a bundle into a folder, in pieces; what does not hold, which ends it."""
    there = {info.filename: info for info in archive.infolist()}
    problems = [f"{name}: missing" for name in files if name not in there]
    problems += [f"{name}: not in {MANIFEST}" for name in there if name not in files and name != MANIFEST]
    problems += [f"{name}: leads out of the bundle" for name in files if _leads_out(name)]
    if problems:
        return problems
    for name, entry in files.items():
        size = there[name].file_size
        if size != entry["bytes"]:
            problems.append(f"{name}: {size} bytes instead of {entry['bytes']}")
        elif name.endswith(".json") and "/model/" not in name and size > LONGEST:
            problems.append(f"{name}: {size} bytes, more than any has")
    if problems:
        return problems
    if (needed := sum(entry["bytes"] for entry in files.values())) > shutil.disk_usage(folder).free:
        raise OSError(errno.ENOSPC, f"its files have {needed} bytes, and {folder} has less room (TMPDIR)")
    for name, entry in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        with opened(archive, name) as source, target.open("xb") as out:
            while piece := source.read(_PIECE):
                digest.update(piece)
                out.write(piece)
        if digest.hexdigest() != entry["sha256"]:
            problems.append(f"{name}: its SHA-256 is another")
    return problems


def _leads_out(name: str) -> bool:
    """Whether a name is none of a file below a folder, on any system and for any program."""
    parts = name.split("/")
    return (
        not all(parts)
        or {".", ".."} & {*parts} != set()
        or any(c in name for c in "\\:\0")
        or (not name.isprintable())
    )


def _check_store(root: Path, manifest: dict[str, Any], most: int) -> Verdict:
    try:
        Store(root)
        ladders = ladders_of(root)
    except DataError as error:
        return Verdict([f"{Path(str(error.what)).name}: {error.reason}"])
    files = {Path(name).stem: root / name for name in manifest["files"] if name.startswith("tables/")}
    problems: list[str] = []
    evidence = Evidence(_records(root, files.keys(), problems, most))
    if problems:
        return Verdict(problems)
    for record in evidence:
        problems += contradictions(record, evidence)
    if _distinct(manifest["environments"]) != _distinct(record.provenance for record in evidence):
        problems.append(f"{MANIFEST}: its environments are not those of the records")
    notes = absences(evidence)
    problems += _check_tables(evidence, ladders, files, manifest["schema_version"])
    return Verdict(problems, notes)


def _records(root: Path, tables: Collection[str], problems: list[str], most: int) -> Iterator[Record]:
    """The records without what only tables hold that the bundle lacks; what is wrong with them is added.

    Those parts are most of what a record takes in memory. Beyond so many values of all, no more is read.
    """
    for path in sorted((root / "jobs").glob("*/record.json")):
        most -= number_of_values(path.read_text(encoding="utf-8"))
        if most < 0:
            problems.append(
                f"jobs/{path.parent.name}: the records have more values than a bundle of its size"
            )
            return
        try:
            record = read_record(path)
        except DataError as error:
            problems.append(f"jobs/{path.parent.name}: {error.reason}")
            continue
        if hash_of(record.job.identity) != record.job.key:
            problems.append(f"{record.job.id}: its name does not follow from what it ran")
        if record.started >= SEALED_SINCE and not is_sealed(path):
            problems.append(f"{record.job.id}: has no checksum, and ran when all records had one")
        problems += _check_model(root, record)
        for table, name in record.result.long.items() if record.result is not None else ():
            if table not in tables:
                getattr(record.result, name).clear()
        yield record


def _distinct(machines: Iterable[Provenance | None]) -> set[str]:
    """Machines and versions without what differs from job to job."""
    return {one.model_dump_json(exclude={"source", "threads"}) for one in machines if one is not None}


def _check_tables(
    evidence: Evidence, ladders: list[Ladder], files: dict[str, Path], schema: int
) -> Iterator[str]:
    stored = stored_tables(evidence, ladders=ladders)
    jobs = stored["jobs"]
    tables = {name for name, table in stored.items() if len(table)}
    # Bundles of schema 2 repeat the axes in every table instead of a table of jobs.
    if schema < SCHEMA:
        tables.discard("jobs")
    for name in sorted((tables - _LONG) | files.keys()):
        text = files[name].read_text(encoding="utf-8") if name in files else ""
        # A bundle may be older than a column of its tables.
        columns = text.partition("\n")[0].split(",")
        table = joined({"jobs": jobs, name: stored.pop(name)})[name] if name in tables else None
        known = table is not None and len(columns) == len(set(columns) & set(table.columns))
        if table is None or not known or not _same(text, to_csv(table[columns])):
            yield f"tables/{name}.csv: does not follow from the records"


def _same(text: str, derived: str) -> bool:
    """Whether two CSV texts are equal, but for columns of :data:`_REVISED`."""
    if text == derived:
        return True
    head = text.partition("\n")[0]
    if head != derived.partition("\n")[0] or not _REVISED & set(head.split(",")):
        return False
    if len(text) > 10 * len(derived):  # a column of names makes none so much longer
        return False
    try:
        rows, others = (list(csv.reader(io.StringIO(one))) for one in (text, derived))
    except csv.Error:
        return False
    kept = [place for place, column in enumerate(rows[0]) if column not in _REVISED]
    picked = ([[row[place] for place in kept] for row in each] for each in (rows, others))
    return next(picked) == next(picked)


def _check_model(root: Path, record: Record) -> list[str]:
    """Models are optional; the files of one must have the bytes that its ledger counts."""
    folder = root / "jobs" / record.job.id / "model"
    encode = record.of(EncodeResult)
    if encode is None or not folder.is_dir():
        return []
    size = folder_bytes(folder)
    parts = sum(sum(part.values()) for part in encode.ledger.values())
    if size == encode.total_bytes == parts:
        return []
    return [f"{record.job.id}: {size} bytes of model, {encode.total_bytes} measured, {parts} in the ledger"]
