"""What is asked for by ``bench run``, ``bench tune`` and :func:`.bench.api.run`, declared once.

Options of the command line have the names of these fields as their destinations, keywords of the Python API
are these fields.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, Self

from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.run.limits import Limits
from econgs_bench.bench.suites.suite import load_suite

Retry = bool | Literal["failed", "busy"]
"""Finished jobs that run again: failed ones (or True), or those with a disturbed time."""


@dataclass(frozen=True)
class Execution:
    """How jobs are run.

    Attributes:
        retry: finished jobs that run again.
        limits: of each job; those of :mod:`.bench.run.limits` by default.
        executor: "dask" runs jobs beside each other on workers of Dask.
        scheduler: address of Dask's scheduler; "": one on this machine.
        workers: how many are started on this machine; None: 1.
    """

    retry: Retry = False
    limits: Limits = field(default_factory=Limits)
    executor: str = "local"
    scheduler: str = ""
    workers: int | None = None


@dataclass(frozen=True)
class RunRequest:
    """One run.

    Attributes:
        selection: of suite, data and methods.
        out: folder of the run store.
        plugins: folders with methods; none: those that the store remembers.
        execution: how its jobs are run.
    """

    selection: Selection
    out: Path
    plugins: tuple[str, ...] = ()
    execution: Execution = field(default_factory=Execution)

    @classmethod
    def of(cls, suite: str, out: str | os.PathLike[str], plugins: Iterable[Any] = (), **choices: Any) -> Self:
        """A request by the names of its fields.

        Args:
            suite: name, or path of a TOML file.
            out: folder of the run store.
            plugins: folders with methods.
            choices: fields of :class:`.bench.plan.selection.Selection` and :class:`Execution`; others, and
                None, are left out.

        Raises:
            DataError: no such suite.
        """
        given = {name: value for name, value in choices.items() if value is not None}
        return cls(
            Selection(load_suite(suite), **_those(Selection, given)),
            Path(out),
            tuple(map(os.fspath, plugins)),
            Execution(**_those(Execution, given)),
        )


def _those(kind: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """The values that are fields of a class; lists as tuples."""
    names = {one.name for one in fields(kind)} - {"suite", "plugins"}
    chosen = {name: value for name, value in given.items() if name in names}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in chosen.items()}
