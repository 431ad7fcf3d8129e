"""``bench run`` and ``bench plan``."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path
from statistics import median
from typing import Any

from bench.display import make_display, span
from bench.plan import Planner
from bench.records import Job, Record
from bench.selection import Selection
from bench.store import Store
from bench.suites import load_suite


def run(options: Namespace) -> int:
    """Run what a suite and the selectors name, then show the table and write the report."""
    from bench.executor import Limits, LocalExecutor
    from bench.provenance import current_sources
    from bench.tables import build_tables

    planner = _planner(options)
    store = Store(Path(options.out), create=True)
    planned = len(planner.jobs(store))
    sources = current_sources(planner.registry)
    executor = LocalExecutor(
        store,
        planner,
        make_display(),
        retry=options.retry,
        limits=Limits(options.time_limit, options.memory_limit),
        plugins=_plugins(options),
        after=lambda record: build_tables(store, sources) if record.job.kind != "views" else None,
    )
    outcome = executor.run()
    tables = build_tables(store, sources)
    ids = {record.job.id for record in outcome.records}
    shown = {name: tables[name][tables[name]["job"].isin(ids)] for name in ("results", "dvr")}
    if any(map(len, shown.values())):
        from bench.commands.results import print_results, print_table, write_html
        from reports.datasets import costs

        if len(shown["results"]):
            print_results(shown["results"])
        if len(shown["dvr"]):
            print_table(costs(shown["dvr"]))
        page = store.root / "report.html"
        if not options.no_report:
            if outcome.ran or not page.is_file():
                write_html(tables, store, page)
            print(f"report: {page}")
    return _verdict(outcome, planned)


def _verdict(outcome: Any, planned: int) -> int:
    if not outcome.ran and not outcome.unfinished:
        print(f"bench: nothing to run, all {planned} jobs are finished", file=sys.stderr)
    for record in outcome.failed:
        if record.cause is None:
            print(f"bench: {record.job.title}: {record.status}: {record.reason}", file=sys.stderr)
    # That a method cannot compose is a finding about it, not something gone wrong.
    failed = [r for r in outcome.failed if not (r.status == "refused" and r.job.composition and not r.cause)]
    if failed:
        print("bench: --retry runs failed jobs again", file=sys.stderr)
    if outcome.stopped:
        print("bench: stopped; run the same command again to resume", file=sys.stderr)
        return 130
    return 1 if failed or outcome.unfinished else 0


def plan(options: Namespace) -> int:
    """Print the jobs, which of them are done, and how long the rest may take."""
    planner = _planner(options)
    root = Path(options.out)
    store = Store(root) if (root / "store.json").is_file() else None
    jobs = planner.jobs(store)
    records = {record.job.id: record for record in store.records()} if store else {}
    total, unknown = 0.0, 0
    width = max((len(job.id) for job in jobs), default=0)
    for job in jobs:
        record = records.get(job.id)
        state, expected = _state(job, record, records, store)
        if record is None:
            total += expected or 0.0
            unknown += expected is None
        print(f"{job.id:<{width}}  {state:<24}  {job.title}")
    todo = sum(job.id not in records for job in jobs)
    print(f"{len(jobs)} jobs, {len(jobs) - todo} finished, {todo} to do", end="")
    if todo:
        print(f", about {span(total)}" if unknown < todo else ", no past records to estimate from", end="")
        print(f" and {unknown} jobs unlike any finished one" if 0 < unknown < todo else "", end="")
    print()
    if any(job.kind == "partition" and job.id not in records for job in jobs):
        print("(a joint method's fits are known once its partition job has run)")
    return 0


def _state(
    job: Job, record: Record | None, records: dict[str, Record], store: Store | None
) -> tuple[str, float | None]:
    if record is not None:
        return ("done" if record.ok else record.status), None
    expected = estimate(job, records)
    started = store is not None and (store.partial / job.id).is_dir()
    words = "interrupted" if started else "to do"
    return (f"{words}, about {span(expected)}" if expected is not None else words), expected


def estimate(job: Job, records: dict[str, Record]) -> float | None:
    """Median wall time of finished jobs of the same kind, method and preset; None if there is none."""
    alike = [
        r.wall_seconds
        for r in records.values()
        if r.ok and (r.job.kind, r.job.method, r.job.preset) == (job.kind, job.method, job.preset)
    ]
    return median(alike) if alike else None


def _planner(options: Namespace) -> Planner:
    from bench.metrics import METRICS
    from bench.tables import METRICS as MEASURED
    from methods.options import parse_assignments

    selection = Selection(
        suite=load_suite(options.suite),
        datasets=tuple(options.dataset),
        scenes=tuple(options.scene),
        composed=options.composed,
        methods=tuple(options.method),
        seeds=tuple(options.seed),
        preset=options.preset or "",
        split=options.split,
        overrides=parse_assignments(options.set),
        device=options.device,
        plugins=_plugins(options),
    )
    return Planner(selection, {name: METRICS[name].version for name in MEASURED})


def _plugins(options: Namespace) -> tuple[str, ...]:
    return tuple(str(Path(folder).expanduser().resolve()) for folder in options.plugins)
