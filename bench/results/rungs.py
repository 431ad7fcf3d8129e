"""Which measurements are rungs of which ladders, and the ladders that a run store remembers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from econgs_bench.bench.jobs.measure import Measure
from econgs_bench.bench.store.records import Job
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.bench.suites.ladders import Ladder, ladder_of
from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.options import label

FILE = "ladders.json"
"""File of a run store with the ladders of the suites that were run into it."""
_MOST_VALUES = 20_000
"""Values of that file, at which every measurement looks; committed ones have hundreds."""


def remember(store: Store, ladders: Iterable[Ladder]) -> None:
    """Keep the ladders of a suite for the tables of a store; a ladder replaces an older one of its name."""
    if new := {ladder.name: ladder for ladder in ladders}:
        with store.lease("tables"):
            every = {ladder.name: ladder for ladder in ladders_of(store.root)} | new
            text = json.dumps([asdict(ladder) for ladder in every.values()], indent=1)
            write_text(store.root / FILE, text + "\n")


def ladders_of(root: Path) -> list[Ladder]:
    """The ladders of the suites that were run into a store.

    Raises:
        DataError: the file cannot be read.
    """
    path = root / FILE
    if not path.is_file():
        return []
    try:
        return [ladder_of(table, str(path)) for table in json_of(path.read_bytes(), _MOST_VALUES)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(path, f"holds no ladders ({error})", "Delete it, and run the suite again") from error


def rungs_of(job: Job, ladders: Iterable[Ladder]) -> Iterator[dict[str, Any]]:
    """Ladder, place and rung of a measurement on each ladder: columns of the table `rungs`.

    Compositions, edited scenes and saved rates are on none. A dataset that some ladder names is on those that
    name it, and options of a rung are on its own ladder alone.
    """
    if not isinstance(job, Measure) or job.composition or job.edit or job.rate is not None:
        return
    ladders = list(ladders)
    named = {name for ladder in ladders for name in ladder.datasets}
    named |= {rung.scene.rpartition("/")[0] for ladder in ladders for rung in ladder.rungs if rung.scene}
    for ladder in ladders:
        if ladder.datasets and job.dataset in named and job.dataset not in ladder.datasets:
            continue
        place, base = place_of(ladder, job), _base(ladder, job)
        if place is not None and not any(_sets(other, base, job) for other in ladders):
            yield {
                "ladder": ladder.name,
                "purpose": ladder.title,
                "place": place,
                "rungs": len(ladder.rungs),
                "rung": ladder.rungs[place].title(job.method),
                "subject": "" if ladder.of_scenes else f"{job.dataset_name}/{job.subject}",
                "variant": label(base),
                "same_truth": ladder.rungs[place].same_truth,
            }


def place_of(ladder: Ladder, job: Measure) -> int | None:
    """The rung of a measurement, from 0; None if it is on no rung."""
    method = job.method
    if not ladder.is_for(method):
        return None
    names = ladder.options(method)
    chosen = {name: value for name, value in job.overrides.items() if name in names}
    for place, rung in enumerate(ladder.rungs):
        if (
            rung.stress == job.stress
            and rung.scene in ("", f"{job.dataset_name}/{job.subject}")
            and dict(rung.options.get(method, {})) == chosen
        ):
            return place
    return None


def _base(ladder: Ladder, job: Measure) -> dict[str, Any]:
    """Options of a measurement that differ from the preset's, without those of the rungs."""
    names = ladder.options(job.method)
    return {name: value for name, value in job.overrides.items() if name not in names}


def _sets(ladder: Ladder, options: dict[str, Any], job: Measure) -> bool:
    """Whether some options are those of one of its rungs."""
    return bool(options) and any(dict(rung.options.get(job.method, {})) == options for rung in ladder.rungs)
