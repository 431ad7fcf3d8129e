"""What jobs may take, from finished ones like them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from statistics import median
from typing import Any

from bench.records import Job, Record
from bench.store import Store

_ASKED = 9  # jobs whose folders are measured; more would only cost time


@dataclass(frozen=True)
class Estimate:
    """Of one job: wall time in seconds, peak host memory and room on disk in bytes.

    Attributes:
        disk: None where all that is known are records from bundles, which come without the jobs' files.
    """

    seconds: float
    memory: int
    disk: int | None


class Past:
    """Finished jobs of run stores.

    Args:
        stores: where to look; the more, the better the estimates.
    """

    def __init__(self, stores: Iterable[Store]) -> None:
        self._alike: dict[tuple[Any, ...], list[tuple[Store, Record]]] = defaultdict(list)
        self._known: dict[tuple[Any, ...], Estimate] = {}
        for store in stores:
            for record in store.records():
                if record.ok:
                    for likeness in _likenesses(record.job):
                        self._alike[likeness].append((store, record))

    def estimate(self, job: Job) -> Estimate | None:
        """Medians over jobs of the same kind, method, preset and (if there are any) dataset.

        Returns:
            None if nothing like it was ever finished.
        """
        for likeness in _likenesses(job):
            if likeness in self._alike:
                if likeness not in self._known:
                    self._known[likeness] = _median(self._alike[likeness])
                return self._known[likeness]
        return None


def _likenesses(job: Job) -> list[tuple[Any, ...]]:
    """The closest first."""
    loose = (job.kind, job.method, job.preset)
    request = job.request
    sized = (*loose, request.width, request.height, request.train_views, request.test_views)
    return [(*sized, job.dataset_name, len(job.scenes)), (*sized, job.dataset_name), sized, loose]


def _median(found: list[tuple[Store, Record]]) -> Estimate:
    folders = (store.jobs / record.job.id for store, record in reversed(found))
    whole = islice((folder for folder in folders if (folder / "log.txt").is_file()), _ASKED)
    sizes = [sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) for folder in whole]
    return Estimate(
        seconds=median(record.wall_seconds for _, record in found),
        memory=int(median(record.peak_host_bytes or 0 for _, record in found)),
        disk=int(median(sizes)) if sizes else None,
    )
