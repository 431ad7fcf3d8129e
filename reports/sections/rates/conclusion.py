"""Who takes the fewest bytes: average differences of rate-distortion curves (Bjøntegaard's delta)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from econgs_bench.reports import floors, style
from econgs_bench.reports.family import Family, largest
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.rates import intervals as rate_intervals
from econgs_bench.reports.style import MISSING, enumeration, mib

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.curves import Curve, Point
    from econgs_bench.reports.statistics import Views

LEAST_OVERLAP = 0.5
"""Less of the common range, as a share of what both curves span, is warned of."""
INTERPOLATION = "Akima"
"""Of log10(bytes) over PSNR and the other way round; steadier than cubic or PCHIP (Herglotz et al. 2024)."""
_DISAGREE = 0.1


@dataclass(frozen=True)
class Difference:
    """Two curves compared; what could not be computed is None.

    Curves may share PSNR and no sizes (a method that takes a third of the bytes), or sizes and no PSNR.

    Attributes:
        rate: BD-rate: bytes of ``test`` at equal PSNR, in percent of those of ``reference``, minus 100.
        psnr: BD-PSNR: dB that ``test`` is above ``reference`` at equal bytes.
        psnr_range: the PSNR, in dB, over which ``rate`` is an average.
        bytes_range: the bytes per scene over which ``psnr`` is an average.
        rate_interval: 95 % interval of ``rate``, in percent; None without values of test views.
        psnr_interval: 95 % interval of ``psnr``, in dB.
        rate_p: two-sided p-value of ``rate`` by Student's t with the standard error of the block bootstrap of
            views and of seeds, as its interval has it; None without an interval.
        psnr_p: the same of ``psnr``.
        seeds: the fewer of both curves; with 1 the intervals hold the spread of views alone.
        overlap: share of the two curves' PSNR and of their log bytes that is common; the smaller of both, of
            those that are.
        beaten: the method all of whose models are larger and worse than one of the other's; "" if neither.
        warnings: what makes the numbers doubtful, or why one is not there.
        refused: why neither is there.
        scenes: scene -> noise floor of its truth, and the highest PSNR of both fronts, dB.
    """

    dataset: str
    reference: str
    test: str
    rate: float | None = None
    psnr: float | None = None
    psnr_range: tuple[float, float] | None = None
    bytes_range: tuple[float, float] | None = None
    rate_interval: tuple[float, float] | None = None
    psnr_interval: tuple[float, float] | None = None
    rate_p: float | None = None
    psnr_p: float | None = None
    seeds: int = 0
    overlap: float = 0.0
    beaten: str = ""
    warnings: tuple[str, ...] = ()
    refused: str = ""
    scenes: dict[str, tuple[Floor | None, float]] = field(default_factory=dict)


def difference(
    reference: Curve, test: Curve, views: Views | None = None, results: pd.DataFrame | None = None
) -> Difference:
    """BD-rate and BD-PSNR of a curve's front against another's (Bjøntegaard 2001, VCEG-M33).

    Args:
        reference: a curve.
        test: another one.
        views: values of test views, for intervals.
        results: the documented table with the jobs of the points, for intervals.
    """
    import numpy as np

    who = (reference.dataset, reference.title, test.title)
    if refused := "; ".join(filter(None, (reference.problem, test.problem))):
        return Difference(*who, refused=refused)
    fronts = [curve.front for curve in (reference, test)]
    quality = [[point.psnr for point in front] for front in fronts]
    size = [[point.bytes for point in front] for front in fronts]
    common, by_quality = _overlap(*quality)
    common_log, by_size = _overlap(*(list(np.log10(values)) for values in size))
    doubts = [curve.doubt for curve in (reference, test) if curve.doubt]
    if common is None:
        doubts.append(f"no overlap of their PSNR: {_ranges(quality, 2)} dB")
    if common_log is None:
        doubts.append(f"no overlap of their size: {_ranges(size, 0)} B")
    if common is None and common_log is None:
        return Difference(*who, refused="; ".join(doubts))
    overlap = min(share for share in (by_quality, by_size) if share)
    if overlap < LEAST_OVERLAP:
        doubts.append(f"the curves share only {100 * overlap:.0f} % of their range")
    rate = psnr = ends = None
    if common is not None:
        rate = _delta("bd_rate", size, quality, "akima")
        other = _delta("bd_rate", size, quality, "pchip")
        if abs(other - rate) > max(1.0, _DISAGREE * abs(rate)):
            doubts.append(f"interpolations disagree: PCHIP gives {other:+.1f} %")
    if common_log is not None:
        psnr = _delta("bd_psnr", size, quality, "akima")
        ends = (10 ** common_log[0], 10 ** common_log[1])
    around_rate = around_psnr = None
    if views is not None and results is not None:
        first, second = (
            [rate_intervals.RatePoint(one.psnr, one.bytes, one.row["jobs"]) for one in front]
            for front in fronts
        )
        sizes = rate_intervals.sizes(results)
        if rate is not None:
            around_rate = rate_intervals.interval(first, second, _log_bytes, views, sizes)
        if psnr is not None:
            around_psnr = rate_intervals.interval(first, second, _decibels, views, sizes)
    of_rate = of_psnr = p_rate = p_psnr = None
    if rate is not None and around_rate is not None and around_rate.half is not None:
        middle, half = np.log10(1 + rate / 100), around_rate.half
        of_rate = (_percent(middle - half), _percent(middle + half))
        p_rate = around_rate.p_value(middle)
    if psnr is not None and around_psnr is not None and around_psnr.half is not None:
        of_psnr = (psnr - around_psnr.half, psnr + around_psnr.half)
        p_psnr = around_psnr.p_value(psnr)
    seeds = max((one.seeds for one in (around_rate, around_psnr) if one and one.half is not None), default=0)
    beaten = reference.title if _beats(test, reference) else test.title if _beats(reference, test) else ""
    return Difference(
        *who,
        rate,
        psnr,
        common,
        ends,
        of_rate,
        of_psnr,
        p_rate,
        p_psnr,
        seeds,
        overlap,
        beaten,
        tuple(doubts),
        scenes={} if results is None else _heights(fronts, results),
    )


def _heights(
    fronts: Sequence[Sequence[Point]], results: pd.DataFrame
) -> dict[str, tuple[Floor | None, float]]:
    """Scene -> its floor, and the highest PSNR of any model, mean over seeds."""
    points = [point for front in fronts for point in front]
    place = {job: i for i, point in enumerate(points) for job in point.row["jobs"]}
    rows = results[results["job"].isin(place.keys())]
    found = floors.by_scene(records(rows))
    means = rows["psnr"].astype(float).groupby([rows["scene"], rows["job"].map(place)]).mean()
    best = means.groupby(level=0).max()
    return {str(scene): (found[str(scene)], float(psnr)) for scene, psnr in best.items()}


def _beats(curve: Curve, other: Curve) -> bool:
    """Whether one model of a curve is smaller and better than all of another's."""
    smallest, best = other.front[0].bytes, other.front[-1].psnr
    return any(point.bytes < smallest and point.psnr > best for point in curve.front)


def _log_bytes(size: list[float], quality: list[float], size2: list[float], quality2: list[float]) -> float:
    """log10 of the bytes of the second curve at equal PSNR, over those of the first."""
    return math.log10(1 + _delta("bd_rate", [size, size2], [quality, quality2], "akima") / 100)


def _decibels(size: list[float], quality: list[float], size2: list[float], quality2: list[float]) -> float:
    """PSNR of the second curve at equal bytes, less that of the first."""
    return _delta("bd_psnr", [size, size2], [quality, quality2], "akima")


def _percent(log: float) -> float:
    return 100 * (10**log - 1)


def _ranges(curves: list[list[float]], digits: int) -> str:
    return " and ".join(f"{values[0]:,.{digits}f} to {values[-1]:,.{digits}f}" for values in curves)


def _delta(what: str, size: list[list[float]], quality: list[list[float]], method: str) -> float:
    import bjontegaard

    arguments: Any = (size[0], quality[0], size[1], quality[1], method)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # overlap is judged here
        return float(getattr(bjontegaard, what)(*arguments, require_matching_points=False, min_overlap=0))


def _overlap(first: list[float], second: list[float]) -> tuple[tuple[float, float] | None, float]:
    """The common range of two increasing lists, and its share of what they span."""
    low, high = max(first[0], second[0]), min(first[-1], second[-1])
    if low >= high:
        return None, 0.0
    return (low, high), (high - low) / (max(first[-1], second[-1]) - min(first[0], second[0]))


def differences(
    curves: dict[str, list[Curve]], views: Views | None = None, results: pd.DataFrame | None = None
) -> list[Difference]:
    """Of all pairs of a dataset's curves with several points on their front, each against those before it.

    Arguments as of :func:`difference`.
    """
    return [
        difference(reference, test, views, results)
        for rows in curves.values()
        for several in ([curve for curve in rows if len(curve.front) > 1],)
        for i, test in enumerate(several)
        for reference in several[:i]
    ]


@once
def of_report(report: Report) -> list[Difference]:
    """The differences of a report's curves."""
    return differences(report.curves, report.views, report.at_shared_seeds)


HEADS = (
    "Dataset", "Method", "Against", "BD-rate", "95 %", "BD-PSNR [dB]", "95 %", "Seeds", "PSNR shared [dB]",
    "Size shared [MiB]", "Overlap", "Remarks",
)  # fmt: skip
"""Of the table of differences."""


def row(pair: Difference) -> list[str]:
    """A row of the table of differences."""
    who = [pair.dataset, pair.test, pair.reference]
    if pair.refused:
        return [*who, *[MISSING] * 8, f"refused: {pair.refused}"]
    rate = [style.signed(end, 1) for end in pair.rate_interval or ()]
    numbers = [
        MISSING if pair.rate is None else f"{style.signed(pair.rate, 1)} %",
        f"{' to '.join(rate)} %" if rate else MISSING,
        MISSING if pair.psnr is None else style.signed(pair.psnr),
        style.ends(*pair.psnr_interval, sign=True) if pair.psnr_interval else MISSING,
        str(pair.seeds) if pair.seeds else MISSING,
        style.ends(*pair.psnr_range) if pair.psnr_range else MISSING,
        " to ".join(mib(value) for value in pair.bytes_range) if pair.bytes_range else MISSING,
    ]
    return [*who, *numbers, f"{100 * pair.overlap:.0f} %", "; ".join(pair.warnings)]


def conclusion(differences: Iterable[Difference], family: Family) -> str:
    """Which method significantly takes the fewest bytes at equal PSNR, and has the best at equal bytes.

    A method also wins against one that has no PSNR, or no size, in common with it, if it has a model that is
    smaller and better than all of that one's, and its lead where the two can be compared is significant.

    Args:
        differences: of all pairs of curves.
        family: all leads of the page.
    """
    sentences = []
    for dataset, pairs in _by_dataset(differences).items():
        fewest, best = (_verdict(pairs, question, family) for question in _QUESTIONS)
        sentences += [f"On {dataset}, {fewest}.", f"{best[:1].upper()}{best[1:]}."]
    return " ".join(sentences)


def p_values(differences: Iterable[Difference]) -> list[float | None]:
    """Of the leads that :func:`conclusion` is about: by dataset and question, that of the first method."""
    firsts = [
        _first(pairs, question) for pairs in _by_dataset(differences).values() for question in _QUESTIONS
    ]
    return [largest([gap.p for gap in first.gaps]) for first in firsts if first is not None]


class _Gap(NamedTuple):
    """How far a method is ahead of a rival.

    Attributes:
        rival: its title.
        lead: None where the two curves have nothing in common, but one model beats all of the rival's.
        p: of the lead; without one, of the lead in what the two curves share.
        remark: on a lead over a small part of the range.
    """

    rival: str
    lead: float | None
    p: float | None
    remark: str


class _First(NamedTuple):
    """The method that is ahead of all others."""

    name: str
    gaps: list[_Gap]


class _Question(NamedTuple):
    """What methods are compared for.

    Attributes:
        where, feat: what is equal, and what the winner does.
        number, p, other_p: of a difference: the number that answers, its p-value, that of the other number.
        lead: how far the curve is ahead of the reference, from the number; the opposite the other way round.
        words: on a lead over a method.
    """

    where: str
    feat: str
    number: Callable[[Difference], float | None]
    p: Callable[[Difference], float | None]
    other_p: Callable[[Difference], float | None]
    lead: Callable[[float], float]
    words: Callable[[float, str], str]


_BYTES = _Question(
    "at equal PSNR",
    "takes the fewest bytes",
    attrgetter("rate"),
    attrgetter("rate_p"),
    attrgetter("psnr_p"),
    lambda rate: -math.log10(1 + rate / 100),
    lambda lead, other: f"{10**lead:.1f} times fewer than {other}",
)
_PICTURE = _Question(
    "at equal bytes",
    "has the highest PSNR",
    attrgetter("psnr"),
    attrgetter("psnr_p"),
    attrgetter("rate_p"),
    lambda gain: gain,
    lambda lead, other: f"{lead:.1f} dB above {other}",
)
_QUESTIONS = (_BYTES, _PICTURE)


def _first(pairs: Sequence[Difference], question: _Question) -> _First | None:
    """Who is ahead of all others of a dataset; None where nobody is, or nothing can be compared.

    Where two curves share nothing for this question, the other one and :attr:`Difference.beaten` decide.
    """
    gaps: dict[str, list[_Gap]] = {}
    names: dict[str, None] = {}
    for pair in (one for one in pairs if not one.refused):
        number, p = question.number(pair), question.p(pair)
        lead = None if number is None else question.lead(number)
        little = 0 < pair.overlap < LEAST_OVERLAP
        remark = f" [over {100 * pair.overlap:.0f} % of their range]" if little else ""
        for sign, name, rival in ((1, pair.test, pair.reference), (-1, pair.reference, pair.test)):
            names[name] = None
            own = None if lead is None else sign * lead
            if own is None and pair.beaten == rival:
                gaps.setdefault(name, []).append(_Gap(rival, None, question.other_p(pair), remark))
            elif own is not None and own > 0:
                gaps.setdefault(name, []).append(_Gap(rival, own, p, remark))
    ahead = (_First(name, gaps[name]) for name in names if len(gaps.get(name, ())) == len(names) - 1)
    return next(ahead, None)


def _verdict(pairs: Sequence[Difference], question: _Question, family: Family) -> str:
    """Who is significantly ahead of all.

    A remark follows a lead over a method with which little of the range is common.
    """
    if all(question.number(pair) is None for pair in pairs):
        return f"no two curves can be compared {question.where}"
    first = _first(pairs, question)
    if first is None or not family.significant(largest([gap.p for gap in first.gaps])):
        return f"{question.where}, no method significantly {question.feat}"
    leads = sorted(
        ((gap.lead, gap.rival, gap.remark) for gap in first.gaps if gap.lead is not None), reverse=True
    )
    parts = [question.words(lead, rival) + remark for lead, rival, remark in leads]
    own = [pair for pair in pairs if first.name in (pair.test, pair.reference)]
    refused = sorted(
        {pair.reference if pair.test == first.name else pair.test for pair in own if pair.refused}
    )
    if beaten := sorted(gap.rival for gap in first.gaps if gap.lead is None):
        parts.append(f"one model of it is smaller and better than all of {' and '.join(beaten)}")
    if question is _PICTURE and (near := _closeness(pairs, first.name)):
        parts.append(near)
    if max(pair.seeds for pair in own) == 1:
        parts.append("one seed")
    among = f"of the methods that can be compared (not {enumeration(refused)}), " if refused else ""
    return f"{question.where}, {among}{first.name} significantly {question.feat}: {'; '.join(parts)}"


def _closeness(pairs: Sequence[Difference], name: str) -> str:
    """Where a method, or one that it is ahead of, comes near to the noise floor of the truth; "" nowhere."""
    scenes: dict[str, tuple[Floor | None, float]] = {}
    for pair in pairs:
        for scene, (floor, best) in pair.scenes.items() if name in (pair.test, pair.reference) else ():
            scenes[scene] = floor, max(best, scenes.get(scene, (None, best))[1])
    return floors.closeness(scenes.values())


def _by_dataset(differences: Iterable[Difference]) -> dict[str, list[Difference]]:
    groups: dict[str, list[Difference]] = {}
    for pair in differences:
        groups.setdefault(pair.dataset, []).append(pair)
    return groups
