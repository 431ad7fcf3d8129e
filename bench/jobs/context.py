"""The context of a job."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.jobs.monitor import Progress, Stop
from econgs_bench.bench.jobs.truth import Truth
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.methods.interface import Method, MethodSpec, RunsPrograms
from econgs_bench.methods.registry import load_method

SCRATCH = "scratch"


@dataclass
class Context:
    """What a job works with.

    Attributes:
        folder: takes the files of the job.
        store: holds the finished jobs.
        spec: declaration of the method; None for views and dvr.
        threads: limit for torch.
        peak_host_bytes, peak_device_bytes: peak of a part of the job; None: that of the whole process counts.
    """

    job: Job
    folder: Path
    store: Store
    spec: MethodSpec | None
    threads: int
    stop: Stop
    report: Progress
    peak_host_bytes: int | None = None
    peak_device_bytes: int | None = None

    @property
    def scratch(self) -> Path:
        """Folder for files under way, which is removed with the job's end."""
        return self.folder / SCRATCH

    def method(self) -> Method:
        """The implementation of the method; torch, if it imports that, gets the job's threads."""
        assert self.spec is not None
        method = load_method(self.spec)
        if isinstance(method, RunsPrograms):
            method.scratch = self.scratch
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(self.threads)
        return method

    def options(self, job: MethodJob) -> Any:
        """The method's options, typed."""
        assert self.spec is not None
        return self.spec.options(**job.options)

    def input(self, kind: str) -> Record:
        """The finished job of a kind that this one builds on."""
        return self.inputs(kind)[0]

    def inputs(self, kind: str) -> list[Record]:
        """The finished jobs of a kind that this one builds on.

        Raises:
            RuntimeError: there is none, or one of them has failed.
        """
        names = [name for name in self.job.needs if name.startswith(f"{kind}-")]
        records = [record for record in map(self.store.record, names) if record is not None and record.ok]
        if not records or len(records) < len(names):
            raise RuntimeError(f"{self.job.id} needs a finished {kind} job, and there is none")
        return records

    def path_of(self, record: Record) -> Path:
        """The folder of a finished job."""
        return self.store.jobs / record.job.id

    def truth(self, scene: str) -> Truth:
        """What the views job of a scene or composition stored."""
        record = next(record for record in self.inputs("views") if record.job.subject == scene)
        return Truth(self.path_of(record))
