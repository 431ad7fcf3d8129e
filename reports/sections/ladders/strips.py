"""Pictures of ladders: rung by rung until a method breaks, and the flicker between two frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.files import background, inside, read
from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.ladders.table import Row
from econgs_bench.reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

RULE = (
    "Pictures are of one scene, that on which the most methods break, and of one view: that on which the "
    "methods lose most PSNR from the usual run to their last picture, mean over methods. Where test pictures "
    "differ from rung to rung, it is each rung's view with the lowest mean PSNR. A method has no pictures "
    "above its first break, unless rungs are scenes."
)
FACTOR = 8
"""Amplification of the change of error in pictures."""

Picture = NDArray[np.uint8]
ViewsOfJobs = dict[str, dict[str, Row]]
"""Job -> name of a view -> row of `rung_views`."""


@dataclass(frozen=True, eq=False)
class Rung:
    """The pictures of a rung.

    Attributes:
        view: name of the view.
        truth: (height, width, 3) ground truth; None where it is that of the rung above, or missing.
        pictures: method and variant -> picture of the same size.
    """

    view: str
    truth: Picture | None
    pictures: dict[tuple[str, str], Picture]


@dataclass(frozen=True, eq=False)
class Flicker:
    """The change of error between two neighbouring frames.

    Attributes:
        subject: scene of the frames.
        views: names of the two.
        truth: (height, width, 3) ground truth of the second frame.
        changes: method and variant -> (height, width, 3) change of the error, absolute, :data:`FACTOR` times.
        amounts: method and variant -> its root mean square in steps of 1/255.
    """

    subject: str
    views: tuple[str, str]
    truth: Picture
    changes: dict[tuple[str, str], Picture]
    amounts: dict[tuple[str, str], float]


def views_of_jobs(views: pd.DataFrame) -> ViewsOfJobs:
    """The table `rung_views` by job and view."""
    jobs: ViewsOfJobs = {}
    for row in records(views):
        jobs.setdefault(row["job"], {})[row["view"]] = row
    return jobs


def until_break(rows: Sequence[Row]) -> dict[tuple[str, str], dict[int, Row]]:
    """Method and variant -> place -> rung, up to the first break; all where rungs are scenes.

    Args:
        rows: of :func:`.reports.sections.ladders.table.ladders`, of one ladder and subject.
    """
    methods: dict[tuple[str, str], dict[int, Row]] = {}
    broken = set()
    for row in sorted(rows, key=lambda row: row["place"]):
        name = (row["method"], row["variant"])
        if name not in broken:
            methods.setdefault(name, {})[row["place"]] = row
        if row["subject"] and not absent(row["failure"]):
            broken.add(name)
    return methods


def worst_subject(rows: Sequence[Row]) -> str:
    """The subject on which the most methods break; the first of several.

    Args:
        rows: of one ladder, as of :func:`.reports.sections.ladders.table.ladders`.
    """
    breaking: dict[str, set[tuple[str, str]]] = {}
    for row in rows:
        own = breaking.setdefault(row["subject"], set())
        if not absent(row["failure"]):
            own.add((row["method"], row["variant"]))
    return max(breaking, key=lambda subject: len(breaking[subject]))


def choose(rows: Sequence[Row], views: ViewsOfJobs) -> dict[int, str]:
    """Place -> view of its pictures (:data:`RULE`); places without views are left out.

    Args:
        rows: of one ladder and subject.
        views: by job.
    """
    methods = until_break(rows)
    if all(row["same_truth"] for row in rows):
        falls: dict[str, list[float]] = {}
        for places in methods.values():
            first, last = (psnr_of(views.get(places[at]["job"], {})) for at in (min(places), max(places)))
            for view in first.keys() & last.keys():
                falls.setdefault(view, []).append(first[view] - last[view])
        if not falls:
            return {}
        view = max(sorted(falls), key=lambda name: fmean(falls[name]))
        return {row["place"]: view for row in rows}
    chosen = {}
    for place in sorted({row["place"] for row in rows}):
        levels: dict[str, list[float]] = {}
        for places in methods.values():
            for view, psnr in psnr_of(views.get(places[place]["job"], {}) if place in places else {}).items():
                levels.setdefault(view, []).append(psnr)
        if levels:
            chosen[place] = min(sorted(levels), key=lambda name: fmean(levels[name]))
    return chosen


def strip(rows: Sequence[Row], views: ViewsOfJobs, root: Path) -> dict[int, Rung]:
    """Place -> pictures of a rung; empty without picture files.

    Args:
        rows: of :func:`.reports.sections.ladders.table.ladders`, of one ladder and subject.
        views: by job.
        root: folder that the paths in ``views`` are relative to.
    """
    methods = until_break(rows)
    repeated = all(row["same_truth"] for row in rows)
    rungs: dict[int, Rung] = {}
    for place, view in choose(rows, views).items():
        truth, pictures = None, {}
        for name, places in methods.items():
            row = views.get(places[place]["job"], {}).get(view) if place in places else None
            if row is not None and (pair := read_pair(row, root)) is not None:
                truth, pictures[name] = pair
        if pictures:
            rungs[place] = Rung(view, None if repeated and rungs else truth, pictures)
    return rungs


def flicker(rows: Sequence[Row], views: ViewsOfJobs, root: Path) -> Flicker | None:
    """The pair of neighbouring frames with the largest mean change of error over methods.

    Args:
        rows: of :func:`.reports.sections.ladders.table.ladders`, those with a flicker.
        views: by job.
        root: folder that the paths in ``views`` are relative to.
    """
    best: tuple[float, Flicker] | None = None
    subjects: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = tuple(
            row[name] for name in ("ladder", "preset", "split", "requested_views", "subject", "place")
        )
        subjects.setdefault(key, []).append(row)
    for own in subjects.values():
        errors = {}
        truths: dict[str, Picture] = {}
        for row in own:
            pairs = {view: read_pair(each, root) for view, each in views.get(row["job"], {}).items()}
            frames = {view: pair for view, pair in sorted(pairs.items()) if pair is not None}
            if frames:
                name = (row["method"], row["variant"])
                errors[name] = {
                    view: picture.astype(np.float32) - truth for view, (truth, picture) in frames.items()
                }
                truths |= {view: truth for view, (truth, _) in frames.items()}
        for one, other in pairwise(sorted(truths)):
            changes = {
                name: np.abs(frames[other] - frames[one])
                for name, frames in errors.items()
                if one in frames and other in frames
            }
            amounts = {
                name: float(np.sqrt(np.square(change, dtype=np.float64).mean()))
                for name, change in changes.items()
            }
            mean = fmean(amounts.values()) if amounts else 0.0
            if mean > 0 and (best is None or mean > best[0]):
                shown = {
                    name: np.minimum(FACTOR * change, 255.0).astype(np.uint8)
                    for name, change in changes.items()
                }
                subject = own[0]["subject"] or f"{own[0]['dataset']}/{own[0]['scene']}"
                best = mean, Flicker(subject, (one, other), truths[other], shown, amounts)
    return best[1] if best else None


def psnr_of(views: dict[str, Row]) -> dict[str, float]:
    """View -> PSNR, of those that have one."""
    return {name: float(row["psnr"]) for name, row in views.items() if not absent(row["psnr"])}


def read_pair(row: Row, root: Path) -> tuple[Picture, Picture] | None:
    """Truth and picture of a view; None where one cannot be read."""
    try:
        color = background(row["background"])
        truth, picture = (read(inside(root, row[name]), color) for name in ("truth_file", "render_file"))
    except (OSError, ValueError, SyntaxError):
        return None
    return (truth, picture) if truth.shape == picture.shape else None
