"""The answers to "which method?": one per criterion, as values and as a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from reports.conclusions.contest import Cells, Contest, Values
from reports.conclusions.effects import Effect, effect
from reports.schema import COLUMNS
from reports.style import absent, label

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Criterion:
    """Something a reader wants of a method.

    Attributes:
        title: the criterion, as a superlative.
        column: the measured column.
        comparative: of the better method against another.
        ratio: values differ by factors.
    """

    title: str
    column: str
    comparative: str
    ratio: bool = True


CRITERIA = (
    Criterion("Smallest", "size_bytes", "smaller"),
    Criterion("Best picture", "psnr", "higher", ratio=False),
    Criterion("Fastest to train", "train_seconds", "faster"),
    Criterion("Fastest to draw", "fps", "faster"),
    Criterion("Least memory", "group_peak_host_bytes", "less"),
)
ROBUST = "Most robust"
EDITABLE = "Can be edited"


@dataclass(frozen=True)
class Place:
    """A method's place under a criterion.

    Attributes:
        method: its name.
        value: mean over datasets of the means over scenes; geometric of ratios.
        text: the value for people, with its unit.
    """

    method: str
    value: float
    text: str


@dataclass(frozen=True)
class Answer:
    """What the tables say about one criterion.

    Attributes:
        title: the criterion.
        places: the ranked methods, best first; empty without an answer.
        winner: the best method, if the difference to the next is sure; "" otherwise.
        sentence: the answer for people, with its uncertainty.
        lead: the best method against the next, if both have values.
    """

    title: str
    places: tuple[Place, ...]
    winner: str
    sentence: str
    lead: Effect | None = None


def answers(contest: Contest, results: pd.DataFrame) -> list[Answer]:
    """One answer per criterion.

    Args:
        contest: the methods and rows that are compared.
        results: the table that the contest is from; its edited scenes decide about editing.
    """
    return [
        *(answer(criterion, contest) for criterion in CRITERIA),
        robustness(contest),
        editing(contest, results),
    ]


def answer(criterion: Criterion, contest: Contest) -> Answer:
    """The answer to one criterion of :data:`CRITERIA`."""
    column = COLUMNS[criterion.column]
    values = contest.values(criterion.column)
    cells = {name: own for name, own in values.cells.items() if own}
    if len(cells) < 2:
        return Answer(criterion.title, (), "", f"Not decided: {_gap(criterion, values)}.")
    means = {name: _level(own, criterion.ratio) for name, own in cells.items()}
    order = sorted(means, key=lambda name: -column.better * means[name])
    unit = column.display_unit
    places = tuple(
        Place(name, means[name], f"{column.text(means[name])}{f' {unit}' if _bare(criterion.column) else ''}")
        for name in order
    )
    lead = effect(cells[order[0]], cells[order[1]], column.better, criterion.ratio)
    assert lead is not None  # all methods have the same datasets
    sentence = _sentence(criterion, places, lead, contest)
    return Answer(
        criterion.title, places, order[0] if lead.sure else "", sentence + _caution(values), lead
    )


def robustness(contest: Contest) -> Answer:
    """Which method has the smallest worst case: fewest failures, then the smallest shortfall of PSNR.

    A method's shortfall on a scene is the distance of its PSNR, mean over seeds, to that of the best method.
    """
    shortfalls = _shortfalls(contest)
    if not shortfalls:
        return Answer(ROBUST, (), "", "Not decided: no scene was finished by two methods.")
    worst = {name: max(own.items(), key=lambda pair: pair[1]) for name, own in shortfalls.items()}
    failures = contest.failures
    order = sorted(worst, key=lambda name: (failures[name], worst[name][1]))
    places = tuple(
        Place(name, worst[name][1], f"\N{MINUS SIGN}{worst[name][1]:.1f} dB{_failed(failures[name])}")
        for name in order
    )
    first, second = order[0], order[1] if len(order) > 1 else ""
    where, most = worst[first]
    scenes = len(shortfalls[first])
    text = (
        f"{label(first)}: at worst {most:.1f} dB behind the best method"
        f"{f' ({where})' if most > 0 else ''}{_failed(failures[first])}"
    )
    if second:
        text += (
            f"; next {label(second)} with {worst[second][1]:.1f} dB ({worst[second][0]})"
            f"{_failed(failures[second])}"
        )
    tie = bool(second) and (failures[first], most) == (failures[second], worst[second][1])
    return Answer(ROBUST, places, "" if tie else first, f"{text}. The worst of {scenes} scenes.")


def _shortfalls(contest: Contest) -> dict[str, dict[str, float]]:
    """Method -> scene -> distance to the best PSNR, where at least two methods finished."""
    psnr: dict[str, dict[str, list[float]]] = {}
    for row in contest.rows:
        if row["status"] == "ok" and not absent(row["psnr"]) and row["method"] in contest.methods:
            scene = f"{row['dataset']} / {row['scene']}"
            psnr.setdefault(scene, {}).setdefault(row["method"], []).append(float(row["psnr"]))
    shortfalls: dict[str, dict[str, float]] = {}
    for scene, methods in psnr.items():
        means = {name: float(np.mean(values)) for name, values in methods.items()}
        for name, mean in means.items() if len(means) > 1 else ():
            shortfalls.setdefault(name, {})[scene] = max(means.values()) - mean
    return shortfalls


def editing(contest: Contest, results: pd.DataFrame) -> Answer:
    """Which method makes the most of the requested edits, and with the best pictures among those."""
    edited = results[(results["kind"] == "edited") & (results["variant"].fillna("") == "")]
    done: dict[str, dict[tuple[str, str], list[float]]] = {}
    refused: dict[str, set[tuple[str, str]]] = {}
    columns = (edited[name] for name in ("method", "dataset", "scene", "edit", "status", "psnr"))
    for method, dataset, scene, edit, status, psnr in zip(*columns, strict=True):
        if status == "ok" and not absent(psnr):
            done.setdefault(str(method), {}).setdefault((f"{dataset} / {scene}", edit), []).append(float(psnr))
        else:
            refused.setdefault(str(method), set()).add((f"{dataset} / {scene}", edit))
    every = {edit for edits in [*done.values()] for edit in edits}.union(*refused.values())
    methods = list(dict.fromkeys([*done, *refused]))
    if not every:
        return Answer(EDITABLE, (), "", "Not measured: no suite with edits was run (`bench run editing`).")
    shared = set.intersection(*(set(edits) for edits in done.values())) if done else set()

    def quality(name: str) -> float:
        own = done.get(name, {})
        chosen = shared or set(own)
        return float(np.mean([np.mean(own[edit]) for edit in chosen])) if chosen and own else -math.inf

    order = sorted(methods, key=lambda name: (-len(done.get(name, ())), -quality(name)))
    places = tuple(
        Place(
            name,
            len(done.get(name, ())),
            f"{len(done.get(name, ()))} of {len(every)}"
            + (f", {quality(name):.2f} dB" if name in done else ""),
        )
        for name in order
    )
    able = [name for name in order if name in done]
    if not able:
        return Answer(EDITABLE, places, "", f"No method made any of the {len(every)} edits.")
    text = "; ".join(f"{label(place.method)} {place.text}" for place in places if place.method in done)
    unable = [label(name) for name in order if name not in done]
    text += f". Refused by {', '.join(unable)}" if unable else ""
    untried = [label(name) for name in contest.methods if name not in methods]
    text += f". Not tried: {', '.join(untried)}" if untried else ""
    alone = len(able) == 1 or len(done[able[0]]) > len(done[able[1]])
    return Answer(EDITABLE, places, able[0] if alone else "", f"Edits done, PSNR of shared ones: {text}.")


def _level(cells: Cells, ratio: bool) -> float:
    """Mean over datasets of the means over scenes of the means over seeds; geometric of ratios."""
    scale = math.log if ratio else float
    means = [
        np.mean([np.mean([scale(value) for value in seeds.values()]) for seeds in scenes.values()])
        for scenes in cells.values()
    ]
    mean = float(np.mean(means))
    return math.exp(mean) if ratio else mean


def _sentence(criterion: Criterion, places: tuple[Place, ...], lead: Effect, contest: Contest) -> str:
    first, second = places[:2]
    interval = _interval(criterion, lead)
    count = _count(lead.datasets, "dataset")
    if lead.sure:
        text = f"{label(first.method)}, {first.text}: {_amount(criterion, lead)} than {label(second.method)}"
        text += f" ({interval}), on {lead.wins} of {count}"
    else:
        ahead = [place.method for place in places[1:] if not _behind(criterion, contest, first.method, place.method)]
        names = [label(first.method), *(label(name) for name in ahead)]
        text = f"No winner among {_listing(names)}: {label(first.method)} ({first.text}) is "
        text += f"{_amount(criterion, lead)} than {label(second.method)} ({second.text}; {interval}), "
        text += f"on {lead.wins} of {count}"
    return f"{text}; {_seeds(lead)}"


def _behind(criterion: Criterion, contest: Contest, first: str, other: str) -> bool:
    cells = contest.values(criterion.column).cells
    difference = effect(cells[first], cells[other], COLUMNS[criterion.column].better, criterion.ratio)
    return difference is not None and difference.sure


def _amount(criterion: Criterion, lead: Effect) -> str:
    if not criterion.ratio:
        return f"{lead.mean:.2f} {COLUMNS[criterion.column].display_unit} {criterion.comparative}"
    return f"{_factor(lead.factor)} times {criterion.comparative}"


def _interval(criterion: Criterion, lead: Effect) -> str:
    if lead.ends is None:
        return "no interval: nothing repeats"
    low, high = lead.ends
    text = _factor if criterion.ratio else lambda value: f"{value:.2f}".replace("-", "\N{MINUS SIGN}")
    return f"95 %: {text(low)} to {text(high)}"


def _factor(value: float) -> str:
    return f"{value:.2f}" if value < 2 else f"{value:.1f}" if value < 20 else f"{value:.0f}"


def _seeds(lead: Effect) -> str:
    least, most = lead.seeds
    if most == 1:
        return "one seed"
    return f"{least} seeds" if least == most else f"{least} to {most} seeds"


def _caution(values: Values) -> str:
    """Rows that a speed does not count."""
    parts = []
    if values.busy:
        parts.append(f"{_count(values.busy, 'row')} from a busy machine left out")
    if values.elsewhere:
        parts.append(f"{_count(values.elsewhere, 'row')} from other processors left out")
    return f"; {'; '.join(parts)}." if parts else "."


def _gap(criterion: Criterion, values: Values) -> str:
    if values.busy:
        return f"all {values.busy} values are from a busy machine"
    return f"no dataset has {COLUMNS[criterion.column].title.lower()} of all methods"


def _failed(count: int) -> str:
    return f", {_count(count, 'failure')}" if count else ""


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _listing(names: Iterable[str]) -> str:
    *head, last = names
    return f"{', '.join(head)} and {last}" if head else last


def _bare(name: str) -> bool:
    """Whether a column's text lacks its unit."""
    return COLUMNS[name].header.endswith("]")
