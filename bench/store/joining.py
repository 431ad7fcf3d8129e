"""The jobs of one run store in another."""

from __future__ import annotations

import shutil
import uuid

from econgs_bench.bench.store.store import Store


def join(source: Store, target: Store) -> tuple[int, int]:
    """Copy finished jobs that a store lacks; a success goes before a failure.

    Returns:
        Number of jobs taken, and of those there already.
    """
    taken = kept = 0
    for record in source.records():
        name = record.job.id
        with target.lease(name) as lease:
            there = target.record(name)
            if there is not None and (there.ok or not record.ok):
                kept += 1
                continue
            aside = target.partial / f"merge-{uuid.uuid4().hex}"
            try:
                shutil.copytree(source.jobs / name, aside)
                target.put_in_place(aside, name, lease)
            finally:
                shutil.rmtree(aside, ignore_errors=True)
            taken += 1
    return taken, kept
