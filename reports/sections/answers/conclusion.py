"""The answers to "which method?": one per criterion, as ranked values and as a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any

from econgs_bench.reports import floors
from econgs_bench.reports.clocks import decoding
from econgs_bench.reports.comparability import fixed_rays
from econgs_bench.reports.effects import (
    LEAST_DATASETS,
    LEAST_SHARE,
    Cells,
    Effect,
    at_shared_seeds,
    leads,
    mean,
    mean_of,
    pace_between,
)
from econgs_bench.reports.family import Family, largest
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import COLUMNS, records
from econgs_bench.reports.sections.answers.contest import Contest, Values, by_default, of_report
from econgs_bench.reports.sections.ladders import table as ladder_table
from econgs_bench.reports.sections.ladders.conclusion import Tally, tally
from econgs_bench.reports.style import absent, counted, enumeration, label, signed

if TYPE_CHECKING:
    import pandas as pd

BEST_PICTURE = "Best picture"
ROBUST = "Most robust"
EDITABLE = "Can be edited"
_MOST_NAMES = 3
"""Methods that share a first place and are named."""


_UNEQUAL = 1.05
"""Quotient of two methods' reference kernels that is told."""
_SMALLEST = 0.05
"""Distance in dB that is told."""
_WIDE = 5.0
"""Half width of an interval in dB from which it says nothing."""
_WIDE_RATIO = math.log(10.0)
"""The same of a ratio, as its logarithm."""


@dataclass(frozen=True)
class Criterion:
    """Something that a reader wants of a method.

    Attributes:
        title: the criterion, as a superlative.
        column: the measured column.
        comparative: of the better method against another.
        unit: of a value's text, with the space before it; "" where the text has it.
        ratio: values differ by factors.
    """

    title: str
    column: str
    comparative: str
    unit: str = ""
    ratio: bool = True

    @property
    def better(self) -> int:
        """1 if higher is better, -1 if lower is."""
        return COLUMNS[self.column].better

    def amount(self, difference: Effect) -> str:
        """As "3.1 times smaller" or "0.55 dB higher"."""
        if self.ratio:
            return f"{_factor(math.exp(difference.mean))} times {self.comparative}"
        return f"{difference.mean:.2f}{self.unit} {self.comparative}"

    def interval(self, difference: Effect) -> str:
        """The 95 % interval of the same; without one, what would give one."""
        if difference.ends is None:
            return "no interval: add seeds (`--seed 0 --seed 1 --seed 2`) or scenes"
        wide = _WIDE_RATIO if self.ratio else _WIDE
        if (difference.half or 0.0) > max(wide, abs(difference.mean)):
            few = difference.datasets < LEAST_DATASETS
            return f"{counted(difference.scenes, 'scene')} decide nothing" if few else "the datasets disagree"
        return "95 %: " + " to ".join(
            _factor(end) if self.ratio else signed(end, 2, False) for end in difference.ends
        )


CRITERIA = (
    Criterion("Smallest", "size_bytes", "smaller", " MiB"),
    Criterion(BEST_PICTURE, "psnr", "higher", " dB", ratio=False),
    Criterion("Fastest to train", "train_seconds", "faster"),
    Criterion("Fastest to draw", "fps", "faster", " FPS"),
    Criterion("Least memory", "peak_host_bytes", "smaller", " MiB"),
)


@dataclass(frozen=True)
class Place:
    """A method's place under a criterion.

    Attributes:
        method: its name.
        value: its figure; higher or lower is better as the criterion has it.
        text: the figure for people, with its unit.
        firsts: number of scenes on which no other method is better, by means over seeds.
    """

    method: str
    value: float
    text: str
    firsts: int = 0


@dataclass(frozen=True)
class Answer:
    """What the tables say about one criterion.

    Attributes:
        title: the criterion.
        places: the ranked methods, best first; empty without an answer.
        winner: the best method, if its lead is significant; "" otherwise. A count has no test: its first one.
        sentence: the answer for people, with its uncertainty.
        scenes: number of scenes of which ``firsts`` of the places are counted; 0 where they are not.
    """

    title: str
    places: tuple[Place, ...]
    winner: str
    sentence: str
    scenes: int = 0

    def firsts(self, place: Place) -> str:
        """On how many scenes a method is first, for people; "" if on none, or if they are not counted."""
        return f"first on {place.firsts} of {counted(self.scenes, 'scene')}" if place.firsts else ""

    def place(self, method: str) -> tuple[Place, int] | None:
        """A method's place and how many are ahead of it; equal values are equal."""
        own = next((place for place in self.places if place.method == method), None)
        return None if own is None else (own, [place.value for place in self.places].index(own.value))


def answers(contest: Contest, results: pd.DataFrame, ladders: pd.DataFrame, family: Family) -> list[Answer]:
    """One answer per criterion.

    Args:
        contest: the methods and rows that are compared.
        results: the table that the contest is from; its edited scenes decide about editing.
        ladders: the table of ladders (:mod:`.reports.sections.ladders.table`). Those that two methods climbed
            decide about robustness; without any, worst cases do.
        family: all leads of the page.
    """
    climbed = tally(ladders, contest.methods, contest.preset)
    robust = robustness(contest) if climbed is None else stamina(climbed)
    return [*(measured(each, contest, family) for each in CRITERIA), robust, editing(contest, results)]


def answers_of(report: Report, family: Family) -> list[Answer]:
    """The answers of a report's first contest; empty without one."""
    found = of_report(report)
    return answers(found[0], report.results, ladder_table.at_shared_seeds(report), family) if found else []


def scope(contest: Contest) -> str:
    """What is compared, and when a lead counts."""
    datasets = len(next(iter(contest.values("psnr").own.values()), ()))
    whole = len(contest.main & set(contest.scenes))
    rays = "".join(
        f", {text}"
        for text in [fixed_rays(row for row in contest.rows if row["dataset"] in contest.main)]
        if text
    )
    protocol = f", {contest.protocol}" if contest.protocol else ""
    of = counted(whole, "dataset") if datasets == whole else f"{datasets} of {counted(whole, 'dataset')}"
    text = (
        f"{len(contest.methods)} methods with their default options on {of}{protocol}{rays}. "
        "A method wins if its lead on every other is significant: Student's t over datasets (scenes of fewer "
        "than three) and seeds, of rates over views and seeds, with Holm's correction over all leads of this "
        "page (answers, races, rates). Intervals are of one lead, uncorrected. Robustness and edits are "
        "counts without a test."
    )
    if datasets < whole:
        text += " A dataset counts if all methods finished it."
    others = sorted(contest.others.items(), key=lambda one: -one[1])
    names = ", ".join(f"{label(name)} ({count or 'too few scenes'})" for name, count in others)
    text += f" Not ranked, as measured on fewer or other datasets: {names}." if names else ""
    old = ", ".join(f"{label(name)} {count}" for name, count in contest.stale.items())
    return f"{text} Stale rows, which today's methods would not make: {old}." if old else text


def to_text(contest: Contest, answers: Iterable[Answer]) -> list[str]:
    """The same for a terminal, a line each."""
    width = max((len(answer.title) for answer in answers), default=0)
    return [scope(contest), *(f"{answer.title:<{width}}  {answer.sentence}" for answer in answers)]


@dataclass(frozen=True)
class Comparison:
    """The methods under a criterion.

    Attributes:
        values: of the criterion's column.
        means: method -> its mean over datasets, of means over scenes, of means over the seeds that all
            share; best first. Those of ratios are geometric.
        leads: of the first on each other one, in their order.
        cells: method -> the values that the leads are of.
    """

    values: Values
    means: Mapping[str, float]
    leads: tuple[Effect, ...]
    cells: Mapping[str, Cells]

    @property
    def p(self) -> float | None:
        """Of the first one's lead on all others."""
        return largest([lead.p for lead in self.leads])


def compare(criterion: Criterion, contest: Contest) -> Comparison | None:
    """The methods under one criterion of :data:`CRITERIA`; None where fewer than two are measured."""
    values = contest.values(criterion.column)
    means = {name: mean_of(own, criterion.ratio) for name, own in values.cells.items() if own}
    if len(means) < 2:
        return None
    order = sorted(means, key=lambda name: -criterion.better * means[name])
    ahead = leads(order, values.own, criterion.better, criterion.ratio, values.paces)
    return Comparison(values, {name: means[name] for name in order}, *ahead)


def measured(criterion: Criterion, contest: Contest, family: Family) -> Answer:
    """The answer to one criterion of :data:`CRITERIA`: the best mean wins if its lead is significant."""
    compared = compare(criterion, contest)
    if compared is None:
        remark = _caution(contest, contest.values(criterion.column))
        text = f"Not decided: not measured of two methods on one dataset{remark}."
        return Answer(criterion.title, (), "", text)
    column, values, means = COLUMNS[criterion.column], compared.values, compared.means
    order = list(means)
    scenes = _by_scene(values.cells)
    firsts = dict.fromkeys(order, 0)
    for scene in scenes:
        best = max(criterion.better * value for value in scene.values())
        for name, value in scene.items():
            firsts[name] += criterion.better * value == best
    places = tuple(
        Place(name, means[name], column.text(means[name]) + criterion.unit, firsts[name]) for name in order
    )
    ahead = list(zip(places[1:], compared.leads, strict=True))
    near = [(place, one) for place, one in ahead if not family.significant(one.p)]
    rival, lead = (near or ahead)[0]
    first, level = places[0], (order[0], *(place.method for place, _ in near)) if near else ()
    pair = at_shared_seeds(
        {name: compared.cells[name] for name in (first.method, rival.method)}, criterion.ratio
    )
    own, other = (column.text(mean_of(one, criterion.ratio)) + criterion.unit for one in pair.values())
    if near:
        text = f"No winner among {_listing(level)}: {label(first.method)}, {own}, is "
        text += f"{criterion.amount(lead)} than {label(rival.method)} ({other}; "
    else:
        text = f"{label(first.method)}, {own}: {criterion.amount(lead)} than {label(rival.method)} ("
    pace = pace_between(values.paces, first.method, rival.method)
    remarks = [
        criterion.interval(lead),
        f"the reference kernel beside them differs by {pace:.2f} times" if pace >= _UNEQUAL else "",
        family.verdict(lead.p),
    ]
    if lead.mean == 0.0:
        both = f"{label(first.method)} and {label(rival.method)}"
        text = f"No winner among {_listing(level)}: {own} of both {both} on "
        text += counted(lead.datasets, "dataset")
    else:
        text += f"{'; '.join(filter(None, remarks))}), better on {lead.wins} of "
        text += counted(lead.datasets, "dataset")
    near_floor = _closeness(contest, list(pair.values())) if criterion.column == "psnr" else ""
    text += f"; {_seeds(lead)}{near_floor}{_caution(contest, values)}."
    if criterion.column == "fps" and (
        condition := decoding(row for row in contest.rows if row["method"] in means)
    ):
        text += f" {condition}"
    return Answer(criterion.title, places, "" if near else order[0], text, len(scenes))


def _closeness(contest: Contest, pair: Sequence[Cells]) -> str:
    """Where the better one of two methods comes near to the noise floor of the truth; "" nowhere."""
    near = floors.closeness(
        (contest.floors[dataset][scene], max(fmean(one[dataset][scene].values()) for one in pair))
        for dataset, scenes in pair[0].items()
        for scene in scenes
    )
    return f"; {near}" if near else ""


def _by_scene(cells: Mapping[str, Cells]) -> list[dict[str, float]]:
    """Per scene the methods' means over seeds; all methods have the same scenes."""
    some = next(iter(cells.values()))
    return [
        {name: mean(own[dataset][scene].values(), ratio=False) for name, own in cells.items()}
        for dataset, scenes in some.items()
        for scene in scenes
    ]


def stamina(climbed: Tally) -> Answer:
    """Which method holds the most rungs of the ladders that all compared ones climbed; no winner of a tie."""
    held, rungs = climbed.held, climbed.rungs
    order = sorted(held, key=lambda name: -held[name])
    places = tuple(Place(name, held[name], f"{held[name]} of {rungs} rungs") for name in order)
    best = [name for name in order if held[name] == held[order[0]]]
    rest = ", ".join(f"{label(name)} {held[name]}" for name in order[len(best) :])
    subject = label(best[0]) if len(best) == 1 else f"No winner: {_listing(best)}"
    text = f"{subject} hold{'s' if len(best) == 1 else ''} {counted(held[best[0]], 'rung')} of {rungs}"
    text += f" on {counted(climbed.ladders, 'ladder')} from harmless to fatal"
    text += f"; {rest}" if rest else ""
    for name, count in climbed.others.items():
        text += f"; {label(name)} climbed {counted(count, 'ladder')} and is not compared"
    return Answer(ROBUST, places, best[0] if len(best) == 1 else "", f"{text}.")


def robustness(contest: Contest) -> Answer:
    """Which method has the mildest worst case: the fewest failures, then the smallest largest shortfall.

    A method's shortfall on a scene is the distance of its PSNR, mean over seeds, to that of the best method.
    Scenes and seeds count that all methods tried, those with few training views as well.
    """
    if not contest.attempted:
        return Answer(
            ROBUST, (), "", f"Not decided: no scene was tried by all {len(contest.methods)} methods."
        )
    shortfalls = _shortfalls(contest)
    if len(shortfalls) < 2:
        return Answer(ROBUST, (), "", "Not decided: no scene was finished by two methods.")
    farthest = {name: max(own, key=lambda scene: own[scene]) for name, own in shortfalls.items()}
    worst = {name: (shortfalls[name][scene], scene) for name, scene in farthest.items()}
    ranks = {name: (contest.failures[name], worst[name][0]) for name in worst}
    order = sorted(ranks, key=lambda name: ranks[name])

    def text(name: str) -> str:
        distance, scene = worst[name]
        amount = f"at most {distance:.1f}" if distance >= _SMALLEST else f"less than {_SMALLEST}"
        behind = f"behind the best method of a scene by {amount} dB ({scene})"
        failures = contest.failures[name]
        return (behind if distance > 0 else "never behind another method") + (
            f" and {counted(failures, 'failed fit')}" if failures else ""
        )

    places = tuple(
        Place(name, worst[name][0], f"{signed(-worst[name][0], 1, sign=False)} dB") for name in order
    )
    first, second = order[:2]
    scenes = len(set().union(*shortfalls.values()))
    few = len({row["requested_views"] for row in contest.rows if not absent(row["requested_views"])}) > 1
    sentence = (
        f"{label(first)}: {text(first)}; {label(second)}: {text(second)}. "
        f"The worst of {counted(scenes, 'scene')}{', few training views included' if few else ''}."
    )
    return Answer(ROBUST, places, first if ranks[first] < ranks[second] else "", sentence)


def _shortfalls(contest: Contest) -> dict[str, dict[str, float]]:
    """Method -> scene -> distance to the best PSNR, where at least two methods finished."""
    psnr: dict[str, dict[str, Cells]] = {}
    for row in contest.attempted:
        if row["status"] == "ok" and not absent(row["psnr"]):
            scene = f"{row['dataset']} / {row['scene']}"
            own = psnr.setdefault(scene, {}).setdefault(row["method"], {"": {"": {}}})
            own[""][""][row["seed"]] = float(row["psnr"])
    shortfalls: dict[str, dict[str, float]] = {}
    for scene, methods in psnr.items():
        shared = at_shared_seeds(methods, ratio=False)
        means = {name: mean_of(own, ratio=False) for name, own in shared.items()}
        for name, own_mean in means.items() if len(means) > 1 else ():
            shortfalls.setdefault(name, {})[scene] = max(means.values()) - own_mean
    return shortfalls


def editing(contest: Contest, results: pd.DataFrame) -> Answer:
    """Which method makes the most of the edits that all were asked for, and how well those that all can make.

    Methods that were asked for fewer than half as many as another one are not compared.
    """
    edited = by_default(results, "edited")
    edited = edited[(edited["preset"] == contest.preset) & (edited["split"] == contest.split)]
    psnr: dict[str, dict[tuple[str, ...], dict[Any, float]]] = {}
    for row in records(edited):
        place = tuple(str(row[name]) for name in ("dataset", "scene", "edit"))
        own = psnr.setdefault(str(row["method"]), {}).setdefault(place, {})
        if row["status"] == "ok" and not absent(row["psnr"]):
            own[row["seed"]] = float(row["psnr"])
    if not psnr:
        return Answer(EDITABLE, (), "", "Not measured: no suite with edits was run (`bench run editing`).")
    most = max(map(len, psnr.values()))
    compared = {name: own for name, own in psnr.items() if len(own) >= LEAST_SHARE * most}
    edits = set.intersection(*map(set, compared.values()))
    if not edits:
        return Answer(EDITABLE, (), "", "Not decided: no edit was asked of all methods.")
    done = {name: {edit: own[edit] for edit in edits if own[edit]} for name, own in compared.items()}
    able = [name for name, own in done.items() if own]
    shared = set.intersection(*(set(done[name]) for name in able)) if able else set()
    cells = {name: {"": {str(edit): done[name][edit] for edit in shared}} for name in able}
    quality = {
        name: mean_of(own, ratio=False) if shared else -math.inf
        for name, own in at_shared_seeds(cells, ratio=False).items()
    }
    order = sorted(done, key=lambda name: (-len(done[name]), -quality.get(name, 0.0)))
    places = tuple(Place(name, len(done[name]), f"{len(done[name])} of {len(edits)}") for name in order)
    parts = [f"{label(place.method)} makes {place.text}" for place in places if place.value]
    if shared and len(able) > 1:
        values = ", ".join(f"{quality[name]:.2f} dB" for name in order if name in able)
        parts.append(f"PSNR of the {counted(len(shared), 'edit')} that they share: {values}")
    refusing = [name for name in order if not done[name]]
    parts += (
        [f"{_listing(refusing, every=True)} refuse{'s' if len(refusing) == 1 else ''} all"]
        if refusing
        else []
    )
    untried = [name for name in dict.fromkeys([*contest.methods, *psnr]) if name not in compared]
    parts += [f"not tried: {_listing(untried, every=True)}"] if untried else []
    alone = able and (len(able) == 1 or len(done[order[0]]) > len(done[order[1]]))
    return Answer(EDITABLE, places, order[0] if alone else "", f"{'; '.join(parts)}.")


def _factor(value: float) -> str:
    return f"{value:.2f}" if value < 2 else f"{value:.1f}" if value < 20 else f"{value:.0f}"


def _seeds(lead: Effect) -> str:
    least, most = lead.seeds
    if least == 0:
        return "no common seed" if most == 0 else "no common seed of some scenes"
    if least < most:
        return f"{least} to {most} seeds"
    return "one seed" if most == 1 else f"{most} seeds"


def _caution(contest: Contest, values: Values) -> str:
    """Rows that a speed does not count, and methods of which it counts none."""
    omitted = [f"{counted(count, 'row')} {why}" for why, count in values.left_out.items()]
    lacking = [name for name in contest.methods if name not in values.own] if any(values.own.values()) else []
    omitted += [_listing(lacking, every=True)] if lacking else []
    return f"; without {enumeration(omitted)}" if omitted else ""


def _listing(names: Iterable[str], every: bool = False) -> str:
    labels = [label(name) for name in names]
    return f"{len(labels)} methods" if len(labels) > _MOST_NAMES and not every else enumeration(labels)
