"""One run of a selection into a store: what `bench run` and :func:`.bench.api.run` have in common."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from econgs_bench.bench.machine.locks import check_locks
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.results.rungs import remember as remember_ladders
from econgs_bench.bench.run.plugins import plugin_folders, remember, resolved
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import hushed, step

if TYPE_CHECKING:
    from econgs_bench.bench.plan.selection import Selection
    from econgs_bench.bench.run.display import Display
    from econgs_bench.bench.run.executor import Executor, Outcome
    from econgs_bench.bench.run.request import Execution, RunRequest


@dataclass(frozen=True)
class Experiment:
    """A run that has ended.

    Attributes:
        store: where its jobs are.
        planner: its plan.
        plugins: plugin folders of the run.
        outcome: records, and whether it was stopped.
    """

    store: Store
    planner: Planner
    plugins: tuple[str, ...]
    outcome: Outcome


def execute(
    request: RunRequest,
    display: Display,
    plan: Callable[[Selection], Planner] = Planner,
) -> Experiment:
    """Run the jobs of a selection that are not finished yet; the store remembers its plugins and ladders.

    Args:
        request: checked before the store is made; the plugin folders of its selection are chosen here.
        display: shows progress and notices.
        plan: makes the planner of the selection.

    Raises:
        DataError: the selection or the store cannot be used.
    """
    selection, execution = request.selection, request.execution
    run_on = _executor(execution)
    if not execution.scheduler:
        check_device(selection.device)
    check_locks()
    given = resolved(request.plugins)
    folders = plugin_folders(given, request.out)
    step("reading and hashing the data of the plan")
    planner = plan(replace(selection, plugins=folders))
    store = Store(request.out, create=True)
    remember(store, given)
    remember_ladders(store, planner.ladders)
    _announce(planner, store, display)
    run = run_on(store, planner, display, execution, plugins=folders, threads=selection.suite.threads)
    with hushed():
        return Experiment(store, planner, folders, run.run())


def check_device(device: str) -> None:
    """Before any truth is rendered for models that this machine cannot train.

    Raises:
        DataError: it has no such device.
    """
    kind, _, number = device.partition(":")
    if kind != "cuda":
        return
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count <= int(number or 0):
        found = f"sees {count} CUDA devices, numbered from 0," if count else "sees no CUDA device"
        raise DataError(
            f"--device {device}",
            f"torch {torch.__version__} {found} here",
            "Leave it out to run on the CPU; bench doctor says what a GPU needs",
        )


def _executor(execution: Execution) -> Callable[..., Executor]:
    """What makes the executor that is asked for.

    Raises:
        DataError: its package is missing, or the choices do not go together.
    """
    from econgs_bench.bench.run.executor import LocalExecutor

    scheduler, workers = execution.scheduler, execution.workers
    if execution.executor == "local":
        if scheduler or workers is not None:
            given = "--scheduler" if scheduler else "--workers"
            raise DataError(given, "is for clusters", "Add --executor dask")
        return LocalExecutor
    if scheduler and workers is not None:
        raise DataError(
            "--workers", "are started on this machine alone", "Leave out --workers or --scheduler"
        )
    try:
        from econgs_bench.bench.run.cluster import DaskExecutor
    except ModuleNotFoundError as error:
        raise DataError(
            "--executor dask", f"needs the package {error.name}", "pip install 'econgs-bench[cluster]'"
        ) from error
    return DaskExecutor


def _announce(planner: Planner, store: Store, display: Display) -> None:
    """Show a notice if ground truth that is still to be rendered will take the slow marcher."""
    pending = (job for job in planner.jobs(store) if job.kind == "views" and store.record(job.id) is None)
    if planner.renders and any(pending):
        from econgs_bench.datasets.render_views import slow_notice

        with suppress(DataError):  # the machine ended the trial: the views job tries again
            if notice := slow_notice():
                display.note(notice)
