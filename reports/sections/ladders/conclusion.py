"""What ladders say: how many rungs a method holds, where it breaks first, which ladder breaks whom.

The usual run, a ladder's first rung, counts nowhere.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.ladders.table import Row, held, severity
from econgs_bench.reports.style import absent, counted, enumeration, label, signed

if TYPE_CHECKING:
    import pandas as pd

Ladder = tuple[Any, ...]
"""Name, split and number of views."""
Breaks = dict[int, bool]
"""Place of a measured rung -> whether it breaks."""
_LEAST_SHARE = 0.5
"""Share of the ladders of the method with the most that a method needs to be compared."""
_DECIDES = {
    "quality": "change", "vanishing parts": "missing", "collapse": "missing", "floaters": "excess",
}  # fmt: skip
"""Kind of break -> the column that decides it."""
_MOST_NAMES = 4
"""Ladders that a sentence names one by one."""
_CONDITIONS = ("preset", "split", "requested_views")
_HOLDS, _UNKNOWN = "holds", "not measured"


@dataclass(frozen=True)
class Tally:
    """How many rungs methods hold, of those on which all of them were measured.

    Of several scenes on which a ladder is climbed, a rung holds where it holds on all.

    Attributes:
        held: method -> rungs that hold.
        rungs: number of them all.
        ladders: number of ladders.
        others: method that is not compared -> number of ladders that it climbed.
    """

    held: Mapping[str, int]
    rungs: int
    ladders: int
    others: Mapping[str, int]


def tally(table: pd.DataFrame, methods: Collection[str], preset: str) -> Tally | None:
    """Compare methods with their default options; None without a rung that two of them climbed.

    Args:
        table: of :func:`.reports.sections.ladders.table.ladders`.
        methods: to compare. Those with fewer than half as many ladders as another one are left out.
        preset: of the rows that count.
    """
    climbs: dict[str, dict[Ladder, dict[str, Breaks]]] = {}
    for row in records(table):
        if row["method"] in methods and row["preset"] == preset and not row["variant"]:
            ladder = (row["ladder"], row["split"], row["requested_views"])
            subjects = climbs.setdefault(row["method"], {}).setdefault(ladder, {})
            subjects.setdefault(row["subject"], {})[row["place"]] = not absent(row["failure"])
    most = max(map(len, climbs.values()), default=0)
    compared = [name for name in methods if len(climbs.get(name, ())) >= max(1.0, _LEAST_SHARE * most)]
    if len(compared) < 2:
        return None
    counts = dict.fromkeys(compared, 0)
    rungs = ladders = 0
    for ladder in set.intersection(*(set(climbs[name]) for name in compared)):
        own = {name: climbs[name][ladder] for name in compared}
        common = set.intersection(*(set(each) for each in own.values()))
        shared = {
            subject: set.intersection(*(set(each[subject]) for each in own.values())) for subject in common
        }
        places = set().union(*shared.values()) - {0}
        rungs += len(places)
        ladders += bool(places)
        for name, each in own.items():
            broken = {at for subject, all_have in shared.items() for at in all_have if each[subject][at]}
            counts[name] += len(places - broken)
    others = {name: len(climbs.get(name, ())) for name in methods if name not in compared}
    return Tally(counts, rungs, ladders, others) if rungs else None


def by_method(climbs: Iterable[Row]) -> dict[tuple[str, str], list[Row]]:
    """Method and variant -> its climbs, the earliest break first.

    Args:
        climbs: as of :func:`.reports.sections.ladders.table.climbed`.
    """
    methods: dict[tuple[str, str], list[Row]] = {}
    for climb in climbs:
        methods.setdefault((climb["method"], climb["variant"]), []).append(climb)
    return {name: sorted(own, key=severity) for name, own in sorted(methods.items())}


def verdict(climbs: Sequence[Row]) -> str:
    """Where a method breaks first, in a sentence or two.

    Args:
        climbs: of one method, the earliest break first (:func:`by_method`).
    """
    name = label(climbs[0]["method"], climbs[0]["variant"])
    broken = [climb for climb in climbs if climb["failure"] is not None]
    whole = [
        climb for climb in climbs if climb["failure"] is None and len(climb["outcomes"]) == climb["rungs"]
    ]
    count = counted(len(climbs), "ladder")
    if not broken:
        return f"{name} breaks on none of {count}{_rest(climbs)}."
    first = [climb for climb in broken if severity(climb)[0] == severity(broken[0])[0]]
    text = f"{name} breaks first on {listing(climb['ladder'] for climb in first)}"
    if len(first) == 1:
        text += f" ({words(first[0])})"
    elif severity(first[0])[0] <= 0:
        text += ", at the first rung above the usual run"
    text += f"; it breaks on {len(broken)} of {count}"
    text += f" and holds all rungs of {listing(climb['ladder'] for climb in whole)}" if whole else ""
    return f"{text}{_rest(climbs)}."


def contrasts(climbs: Sequence[Row]) -> list[str]:
    """Sentences on all methods: which ladders break none, which break all alike, and whom each other breaks.

    Args:
        climbs: as of :func:`.reports.sections.ladders.table.climbed`.
    """
    methods = {(climb["method"], climb["variant"]) for climb in climbs}
    none, alike, others = [], [], []
    for ladder in dict.fromkeys(title(climb, climbs) for climb in climbs):
        own = [climb for climb in climbs if title(climb, climbs) == ladder]
        breaks: dict[str, list[str]] = {}
        for climb in sorted(own, key=lambda climb: severity(climb)[:2]):
            name = label(climb["method"], climb["variant"])
            breaks.setdefault(_place(climb), []).append(name)
        if list(breaks) == [_HOLDS]:
            none.append(f"“{ladder}”")
        elif len(breaks) == 1 and len(own) == len(methods) > 1 and _UNKNOWN not in breaks:
            alike.append(f"“{ladder}” at {next(iter(breaks))}")
        else:
            parts = []
            for place, names in breaks.items():
                one = len(names) == 1
                verb = {
                    _HOLDS: "holds" if one else "hold",
                    _UNKNOWN: f"{'is' if one else 'are'} not measured on all rungs",
                }
                does = verb.get(place) or f"{'breaks' if one else 'break'} at {place}"
                parts.append(f"{enumeration(names)} {does}")
            others.append(f"“{ladder}”: {'; '.join(parts)}.")
    first = []
    if none:
        first.append(f"No method breaks on {enumeration(none)}.")
    if alike:
        first.append(f"Every method breaks on {enumeration(alike)}.")
    return first + others


def _place(climb: Row) -> str:
    """Of a climb's first break, as "views=6" or, if it is not of quality, "noise=32 (floaters)"."""
    if climb["failure"] is None:
        return _HOLDS if len(climb["outcomes"]) == climb["rungs"] else _UNKNOWN
    kind = "" if climb["failure"] == "quality" else f" ({climb['failure']})"
    return f"{_rung(climb)}{kind}"


def _rung(climb: Row) -> str:
    """The rung of a climb's first break."""
    return climb["rung"] if climb["place"] else "the usual run"


def title(climb: Row, climbs: Sequence[Row]) -> str:
    """The ladder of a climb, with its conditions where there are several."""
    several = [name for name in _CONDITIONS if len({other[name] for other in climbs}) > 1]
    return " ".join([climb["ladder"], *(f"{climb[name]}" for name in several)])


def words(climb: Row) -> str:
    """A first break, as "views=6 on vis_male/skin: quality, -3.4 dB"."""
    where = f" on {climb['subject']}" if climb["subject"] else ""
    return f"{_rung(climb)}{where}: {', '.join(filter(None, [climb['failure'], amount(climb)]))}"


def amount(climb: Row) -> str:
    """What decides that a first break is one, as "-3.4 dB" or "43 % missing"; "" of failed steps."""
    column = _DECIDES.get(climb["failure"])
    if column is None or absent(climb[column]):
        return ""
    return f"{signed(climb[column], 1)} dB" if column == "change" else f"{100 * climb[column]:.0f} % {column}"


def summary(climbs: Iterable[Row]) -> list[str]:
    """A line per method for a terminal: the rungs that hold, and the first breaks.

    Args:
        climbs: as of :func:`.reports.sections.ladders.table.climbed`.
    """
    methods = by_method(climbs)
    width = max((len(label(*name)) for name in methods), default=0)
    lines = []
    for name, own in methods.items():
        rungs = sum(place > 0 for climb in own for place in climb["outcomes"])
        breaks = [f"{_rung(climb)} ({climb['failure']})" for climb in own if climb["failure"] is not None]
        text = f"breaks at {', '.join(breaks)}" if breaks else "nothing breaks"
        lines.append(
            f"{label(*name):<{width}}  holds {sum(map(held, own))} of {counted(rungs, 'rung')}; {text}"
        )
    return lines


def flickering(amounts: Mapping[tuple[str, str], Mapping[str, float]]) -> str:
    """Who flickers most and who least, mean over the scenes that all methods have.

    Args:
        amounts: method and variant -> scene -> flicker in steps of 1/255.
    """
    shared = set.intersection(*(set(own) for own in amounts.values())) if amounts else set()
    if len(amounts) < 2 or not shared:
        return "No scene compares two methods."
    means = {label(*name): fmean(own[scene] for scene in shared) for name, own in amounts.items()}
    order = sorted(means, key=lambda name: -means[name])
    most, least = order[0], order[-1]
    text = f"{most} flickers most, {means[most]:.2f}, and {least} least, {means[least]:.2f}"
    return f"{text} ({'mean over ' if len(shared) > 1 else ''}{counted(len(shared), 'scene')})."


def listing(names: Iterable[str]) -> str:
    """Names of ladders in quotation marks; of many the first ones and a number."""
    quoted = [f"“{name}”" for name in names]
    if len(quoted) > _MOST_NAMES + 1:
        quoted = [*quoted[:_MOST_NAMES], f"{len(quoted) - _MOST_NAMES} more"]
    return enumeration(quoted)


def _rest(climbs: Iterable[Row]) -> str:
    missing = sum(climb["rungs"] - len(climb["outcomes"]) for climb in climbs)
    return f"; {counted(missing, 'rung')} {'is' if missing == 1 else 'are'} not measured" if missing else ""
