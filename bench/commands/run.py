"""``bench run`` and ``bench plan``."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.bench.commands.arguments import add_execution, add_selection, add_stored, repeatable
from econgs_bench.bench.plan.estimates import Estimate, Past
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.results.versions import of_other_source
from econgs_bench.bench.run.display import make_display, span
from econgs_bench.bench.run.limits import Limits
from econgs_bench.bench.run.plugins import plugin_folders
from econgs_bench.bench.run.request import RunRequest
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.reports.progress import step
from econgs_bench.reports.style import counted

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.bench.run.executor import Outcome


def run_arguments(parser: ArgumentParser) -> None:
    """What ``bench run`` takes."""
    add_stored(parser)
    add_selection(parser)
    add_execution(parser)
    parser.add_argument("--no-report", action="store_true", help="leave the page to a later `bench report`")


def run(options: Namespace) -> int:
    """Run the jobs of a suite and its selectors, then print the results and write the report."""
    from econgs_bench.bench.results.tables import build_tables, stored_tables
    from econgs_bench.bench.run.experiment import execute
    from econgs_bench.reports.schema import joined

    done = execute(request(options), make_display())
    store, planner, outcome = done.store, done.planner, done.outcome
    step("making tables and the report")
    methods = planner.registry.specs
    tables = build_tables(store, methods)
    # The rows of this run alone, as the store's tables have them beside all others.
    frames = joined(stored_tables(outcome.records, methods, planner.ladders))
    own = tables["results"][tables["results"]["job"].isin(frames["results"]["job"])]
    if len(own) == len(frames["results"]):  # else a newer measurement has taken the place of one
        frames["results"] = own
    if len(frames["results"]) or len(frames["rungs"]) or len(frames["dvr"]):
        from econgs_bench.bench.commands.results import print_answers, print_results, print_table
        from econgs_bench.reports.sections.ladders.conclusion import summary
        from econgs_bench.reports.sections.ladders.table import climbed, ladders
        from econgs_bench.reports.sections.paper.datasets import costs
        from econgs_bench.reports.terminal import print_prose

        if len(frames["results"]):
            print_results(frames["results"])
        if (frames["rungs"]["stress"].fillna("") != "").any():
            print_prose("\n".join(summary(climbed(ladders(frames["rungs"])))))
        if len(frames["dvr"]):
            print_table(costs(frames["dvr"]))
        page = store.root / "report.html"
        if not options.no_report:
            if outcome.ran or not page.is_file():
                from econgs_bench.reports.page.document import write_report
                from econgs_bench.reports.report import Report
                from econgs_bench.reports.sections.paper.layouts import layouts
                from econgs_bench.reports.sections.paper.tables import lacking, paper_tables

                contents = Report(tables)
                paper = paper_tables(tables, contents.views)
                write_report(tables, store.root, page, paper, contents)
                print_answers(contents)
                suite = Path(options.suite).stem
                if suite in layouts()["tables"] and suite not in {table.name for table in paper}:
                    print_prose(lacking(tables["results"], [suite]))
            print(f"report: {page}")
    if count := _disturbed(frames["results"]):
        text = f"{counted(count, 'time')} disturbed by other work on the machine"
        print(f"bench: {text}; --retry busy measures again", file=sys.stderr)
    if names := of_other_source(outcome.records, methods):
        text = f"fitted by other source than is installed: {', '.join(names)}"
        print(f"bench: {text}; a higher version in its spec, or a new --out, fits anew", file=sys.stderr)
    return _verdict(outcome, store)


def _disturbed(results: pd.DataFrame) -> int:
    """Number of times that take no part in conclusions, as something disturbed them."""
    from econgs_bench.reports.clocks import CLOCKS
    from econgs_bench.reports.comparability import DISTURBED, kind_of
    from econgs_bench.reports.schema import records

    return sum(kind_of(row, name) == DISTURBED for row in records(results) for name in CLOCKS)


def _verdict(outcome: Outcome, store: Store) -> int:
    if not outcome.ran and not outcome.unfinished:
        print(f"bench: nothing to run, all {len(outcome.records)} jobs are finished", file=sys.stderr)
    for record in outcome.failed:
        if record.cause is None:
            print(f"bench: {record.job.title}: {record.status}: {record.reason}", file=sys.stderr)
            log = store.jobs / record.job.id / "log.txt"
            if record.status not in ("refused", "diverged") and log.is_file():
                print(f"bench:   log: {log}", file=sys.stderr)
    failed = [record for record in outcome.failed if not _is_finding(record)]
    if failed:
        print("bench: --retry runs failed jobs again", file=sys.stderr)
    if outcome.stopped:
        print("bench: stopped; run the same command again to resume", file=sys.stderr)
        return 130
    return 1 if failed or outcome.unfinished else 0


def _is_finding(record: Record) -> bool:
    """Whether a job shows what its method cannot do, compose or edit, and is no failure."""
    asked = record.job.composition or record.job.edit
    return record.status == "refused" and bool(asked) and record.cause is None


def plan_arguments(parser: ArgumentParser) -> None:
    """What ``bench plan`` takes."""
    add_stored(parser)
    add_selection(parser)
    repeatable(
        parser, "--like", metavar="STORE", help="estimate from the finished jobs of this run store too"
    )


def plan(options: Namespace) -> int:
    """Print the jobs, their states, and the time, memory and disk that the rest may take."""
    root = Path(options.out)
    step("reading and hashing the data of the plan")
    folders = plugin_folders(options.plugins, root)
    planner = Planner(replace(request(options).selection, plugins=folders))
    store = Store(root) if (root / "store.json").is_file() else None
    jobs = planner.jobs(store)
    records = {record.job.id: record for record in store.records()} if store else {}
    past = Past([*([store] if store else []), *(Store(Path(folder)) for folder in options.like)])
    estimates = {job.id: past.estimate(job) for job in jobs if job.id not in records}
    width = max((len(job.id) for job in jobs), default=0)
    for job in jobs:
        state = _state(job, records.get(job.id), estimates.get(job.id), store)
        print(f"{job.id:<{width}}  {state:<24}  {job.title}")
    print(f"{len(jobs)} jobs, {len(jobs) - len(estimates)} finished, {len(estimates)} to do", end="")
    usable = [estimate for estimate in estimates.values() if estimate is not None]
    if usable:
        seconds = sum(one.seconds_for(job) for job in jobs if (one := estimates.get(job.id)) is not None)
        disk = [one.disk for one in usable if one.disk is not None]
        room = f"{_mib(sum(disk))} of disk" if disk else "unknown room on disk"
        print(f", about {span(seconds)}, {room}", end="")
        if disk and len(disk) < len(usable):
            print(f" (without {len(usable) - len(disk)} jobs known from bundles alone)", end="")
        print(f", {_mib(max(one.memory for one in usable))} of memory", end="")
        if len(usable) < len(estimates):
            print(f" and {len(estimates) - len(usable)} jobs unlike any finished one", end="")
    elif estimates:
        print(", no past records to estimate from (--like STORE names some)", end="")
    print()
    total, _ = planner.total(jobs, store)
    if total > len(jobs):
        print(f"(at least {total - len(jobs)} more: a joint method's fits follow from its partition)")
    return 0


def _mib(count: int) -> str:
    return f"{count / 2**20:,.0f} MiB"


def _state(job: Job, record: Record | None, estimate: Estimate | None, store: Store | None) -> str:
    if record is not None:
        return "done" if record.ok else record.status
    words = "to do"
    if store is not None and (store.partial / job.id).is_dir():
        words = "running" if store.lease(job.id).is_held else "interrupted"
    return f"{words}, about {span(estimate.seconds_for(job))}" if estimate is not None else words


def request(options: Namespace, **others: Any) -> RunRequest:
    """What the command line asks for.

    Args:
        options: its arguments, by the names of fields.
        others: further fields, or other values.
    """
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.methods.options import parse_assignments

    samples = getattr(options, "samples", None)
    rays = None if samples is None else samples_of(samples, "--samples")
    given = vars(options) | {"samples": rays, "overrides": parse_assignments(options.set)} | others
    if "time_limit" in given:
        given["limits"] = Limits(options.time_limit, options.memory_limit)
    return RunRequest.of(**given)
