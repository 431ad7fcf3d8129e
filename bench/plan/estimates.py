"""Time, memory and disk that jobs may take, estimated from similar finished jobs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain, islice
from statistics import median
from typing import Any

from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store, folder_bytes

_MEASURED = 9
"""Jobs whose folders are measured; more would only cost time."""


@dataclass(frozen=True)
class Estimate:
    """Estimate for one job: wall time in seconds, peak host memory and disk in bytes.

    Attributes:
        disk: None if all similar jobs came from bundles, which hold records without the jobs' files.
        work: median of their :func:`work`.
    """

    seconds: float
    memory: int
    disk: int | None
    work: float

    def seconds_for(self, job: Job) -> float:
        """Wall time of a job whose work is another: in proportion."""
        return self.seconds * work(job) / self.work


class Past:
    """Finished jobs of run stores.

    Args:
        stores: run stores to read; more of them give better estimates.
        keep: which of their records count, beside that they are a success.
    """

    def __init__(self, stores: Iterable[Store], keep: Callable[[Record], bool] | None = None) -> None:
        self._alike: dict[tuple[Any, ...], list[tuple[Store, Record]]] = defaultdict(list)
        self._estimates: dict[tuple[Any, ...], Estimate] = {}
        for store in stores:
            for record in store.records():
                if keep is None or keep(record):
                    self.add(store, record)

    def add(self, store: Store, record: Record) -> None:
        """Take a further finished job into account."""
        if record.ok:
            for likeness in chain(*_likenesses(record.job)):
                self._alike[likeness].append((store, record))
                self._estimates.pop(likeness, None)

    def estimate(self, job: Job, *, close: bool = False) -> Estimate | None:
        """Medians over jobs of the same kind, method, preset and (if there are any) variant and dataset.

        Args:
            job: the job.
            close: leave out jobs of other variants, and with other numbers or sizes of views.

        Returns:
            None if no similar job is finished.
        """
        close_ones, others = _likenesses(job)
        for likeness in close_ones if close else close_ones + others:
            if likeness in self._alike:
                if likeness not in self._estimates:
                    self._estimates[likeness] = _median(self._alike[likeness])
                return self._estimates[likeness]
        return None


def work(job: Job) -> float:
    """What a job's time grows with: a fit's iterations, which are of all its scenes together; else scenes."""
    iterations = job.iterations if isinstance(job, MethodJob) else None
    return float(iterations or len(job.scenes))


def _likenesses(job: Job) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """Keys that similar jobs share, the closest first: those of the same variant and views, and others."""
    method, label = (job.method, job.variant) if isinstance(job, MethodJob) else (None, "")
    loose = (job.kind, method, job.preset)
    request = job.request
    sized = (*loose, *request.model_dump().values())
    dataset, grouped = (*sized, job.dataset_name), (*sized, job.dataset_name, len(job.scenes))
    variant = ("variant", label)
    return [(*grouped, *variant), (*dataset, *variant), (*sized, *variant)], [grouped, dataset, sized, loose]


def _seconds(record: Record) -> float:
    """Seconds of a job; of a fit that was interrupted, its earlier attempts too."""
    fit = record.of(FitResult)
    return max(record.wall_seconds, fit.seconds if fit is not None else 0.0)


def _median(jobs: list[tuple[Store, Record]]) -> Estimate:
    folders = (store.jobs / record.job.id for store, record in reversed(jobs))
    whole = (folder for folder in folders if (folder / "log.txt").is_file())  # no bundle holds a log
    sizes = list(map(folder_bytes, islice(whole, _MEASURED)))
    return Estimate(
        seconds=median(_seconds(record) for _, record in jobs),
        memory=int(median(record.peak_host_bytes or 0 for _, record in jobs)),
        disk=int(median(sizes)) if sizes else None,
        work=median(work(record.job) for _, record in jobs),
    )
