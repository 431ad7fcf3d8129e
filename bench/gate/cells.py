"""Cells: the results of one method on one scene at one setting, over seeds."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from econgs_bench.bench.gate.identity import Identity
from econgs_bench.bench.gate.quantities import QUANTITIES
from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.store.store import Store
from econgs_bench.reports.clocks import CLOCKS, Clocks
from econgs_bench.reports.style import absent, label
from econgs_bench.reports.tables.protocols import by_scene_choice

if TYPE_CHECKING:
    import pandas as pd

Options = dict[str, bool | int | float | str]
"""Option -> value."""
Values = dict[str, float]
"""Quantity -> value."""
VIEW_METRIC = "psnr"
"""The metric that is compared view by view."""


AND = " and "
"""Between versions or processors of several seeds."""


class Key(NamedTuple):
    """What a cell is about; its fields are axes of the table `results`."""

    dataset: str
    scene: str
    method: str
    variant: str
    rate: float | None
    preset: str
    split: str
    requested_views: int

    @classmethod
    def of(cls, row: Mapping[Any, Any]) -> Key:
        """The key of a row of `results`."""
        values: list[Any] = [_plain(row[name]) for name in cls._fields]
        return cls(*values)

    @property
    def title(self) -> str:
        rate = f" @ {self.rate:g}" if self.rate is not None else ""
        views = f", {self.requested_views} views"
        split = "" if self.split == "test" else f", {self.split}"
        model = f"{label(self.method, self.variant)}{rate}"
        return f"{self.dataset}/{self.scene} {model} ({self.preset}{views}{split})"


@dataclass
class Cell:
    """Results by seed.

    Attributes:
        version: of the method; those of all seeds, joined by "and".
        processor: hardware and threads of the fits, as ``version``; times of others do not compare.
        values: seed -> quantity -> value; what could not be measured is missing.
        views: seed -> view -> :data:`VIEW_METRIC`, in the order of the path.
        models: seed -> SHA-256 of the model's files, where the store has them.
        kernels: seconds of the reference kernel beside the cell's times.
        busy: number of times that were measured on a busy machine, which count nothing.
        failures: seed -> status and reason.
        options: seed -> the method's options as they were resolved, and the iterations.
        identities: seed -> what it was measured on and by.
    """

    key: Key
    version: str
    processor: str
    values: dict[int, Values] = field(default_factory=dict)
    views: dict[int, Values] = field(default_factory=dict)
    models: dict[int, str] = field(default_factory=dict)
    kernels: list[float] = field(default_factory=list)
    busy: int = 0
    failures: dict[int, str] = field(default_factory=dict)
    options: dict[int, Options] = field(default_factory=dict)
    identities: dict[int, Identity] = field(default_factory=dict)


def cells_of(store: Store, tables: Mapping[str, pd.DataFrame]) -> dict[Key, Cell]:
    """The cells of a store's basic scenes, compositions and edits.

    Args:
        store: where the model's files are.
        tables: of the store.
    """
    results = by_scene_choice(tables["results"])
    clocks = Clocks(results)
    models = _Models(store)
    paths = dict(_views(tables["views"]))
    cells: dict[Key, Cell] = {}
    for row in results.to_dict("records"):
        key = Key.of(row)
        processor = f"{_plain(row['fit_processor'])}; {_plain(row['threads'])} threads"
        version = str(_plain(row["method_version"]))
        cell = cells.setdefault(key, Cell(key, version, processor))
        seed = int(row["seed"])
        if row["status"] != "ok":
            cell.failures[seed] = f"{row['status']}: {_plain(row['reason'])}"
            continue
        cell.options[seed] = _options(store, row["job"])
        cell.version = _joined(cell.version, version) if cell.values else version
        cell.processor = _joined(cell.processor, processor) if cell.values else processor
        cell.identities[seed] = Identity.of(row)
        cell.values[seed] = _values(row, clocks, cell)
        cell.views[seed] = paths.get(row["job"], {})
        if digest := models.digest(row["job"]):
            cell.models[seed] = digest
    return cells


def _joined(known: str, more: str) -> str:
    return known if more in known.split(AND) else f"{known}{AND}{more}"


def _plain(value: Any) -> Any:
    return None if absent(value) else value


def _options(store: Store, job: str) -> Options:
    record = store.record(job)
    assert record is not None
    assert isinstance(record.job, MethodJob)
    iterations = {"iterations": record.job.iterations} if record.job.iterations else {}
    return {**record.job.options, **iterations}


def _values(row: Mapping[Any, Any], clocks: Clocks, cell: Cell) -> Values:
    values = {name: float(row[name]) for name in QUANTITIES if name in row and not absent(row[name])}
    for name, speed in (("train_ratio", "train_seconds"), ("frame_ratio", "fps")):
        seconds, kernel = _seconds(row, name), row[CLOCKS[speed][1]]
        if absent(seconds) or absent(kernel):
            continue
        if clocks.disturbed(row, speed):
            cell.busy += 1
        else:
            cell.kernels.append(float(kernel))
            values[name] = seconds / float(kernel)
    return values


def _seconds(row: Mapping[Any, Any], name: str) -> Any:
    """Processor time of a fit on the CPU, and the quickest frames: other work disturbs them least."""
    if name == "train_ratio":
        return row["cpu_seconds"] if row["device"] == "cpu" else row["train_seconds"]
    return None if absent(row["fps_p95"]) else 1.0 / row["fps_p95"]


def _views(table: pd.DataFrame) -> Iterator[tuple[str, Values]]:
    measured = table[table[VIEW_METRIC].notna()]
    for job, rows in measured.groupby("job", sort=False):
        yield str(job), dict(zip(rows["view"].astype(str), rows[VIEW_METRIC].astype(float), strict=True))


class _Models:
    """Digests of the files behind measure jobs."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._digests: dict[Path, str] = {}

    def digest(self, job: str) -> str:
        """SHA-256 over the models of a job; "" without their files, as in stores from bundles."""
        record = self._store.record(job)
        needs = [] if record is None else [need for need in record.job.needs if need.startswith("encode-")]
        folders = [self._store.jobs / need / "model" for need in needs]
        if not folders or not all(folder.is_dir() for folder in folders):
            return ""
        return hashlib.sha256("".join(map(self._folder, folders)).encode()).hexdigest()[:16]

    def _folder(self, folder: Path) -> str:
        if folder not in self._digests:
            digest = hashlib.sha256()
            for path in sorted(path for path in folder.rglob("*") if path.is_file()):
                digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
            self._digests[folder] = digest.hexdigest()
        return self._digests[folder]
