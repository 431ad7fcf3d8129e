"""Jobs whose times were disturbed, by the rule of :mod:`.reports.clocks`."""

from __future__ import annotations

from collections.abc import Iterable

from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Record


def disturbed_jobs(records: Iterable[Record]) -> dict[str, str]:
    """Job -> why its time is disturbed: of a measurement its FPS, of a fit its training time.

    Args:
        records: of one store, which show how long the reference kernel takes on quiet machines.
    """
    from econgs_bench.bench.results.tables import stored_tables
    from econgs_bench.reports.clocks import Clocks
    from econgs_bench.reports.schema import joined
    from econgs_bench.reports.schema import records as records_of

    lineage = Lineage(records)
    results = joined(stored_tables(lineage))["results"]
    clocks = Clocks(results)
    jobs: dict[str, str] = {}
    for row in records_of(results[results["status"] == "ok"]):
        if reason := clocks.disturbed(row, "fps"):
            jobs[str(row["job"])] = reason
        if row["kind"] == "basic" and (reason := clocks.disturbed(row, "train_seconds")):
            jobs |= {fit.job.id: reason for fit in lineage.fits(lineage.by_id[str(row["job"])])}
    return jobs


def to_measure_again(records: Iterable[Record]) -> dict[str, str]:
    """Job -> when it ended: finished jobs with a disturbed time, and what was made of a fit among them."""
    lineage = Lineage(records)
    again = set(disturbed_jobs(lineage))
    for kind in ("encode", "measure"):  # each needs the one before
        again |= {
            name
            for name, record in lineage.by_id.items()
            if record.job.kind == kind and not again.isdisjoint(record.job.needs)
        }
    return {name: lineage.by_id[name].finished for name in again if lineage.by_id[name].ok}
