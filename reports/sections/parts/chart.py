"""Parts of bytes and of frame times as shares of wholes: the bars and their chart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.charts.chart import INK, Axis, Bar, Chart, Panel, Text
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.sections.parts import families
from econgs_bench.reports.sections.parts.families import OTHER
from econgs_bench.reports.style import Look, label, mib, seconds

if TYPE_CHECKING:
    import pandas as pd

_BAR = ["dataset", "method", "variant", "rate", "preset"]
_BARS = 540.0
"""Width of stacked bars with their totals in pixels."""
_MOST_BARS = 36
"""Stacked bars of a panel: as many as a page of paper holds."""


@dataclass
class Whole:
    """Amounts by part, of one method on one dataset; drawn as shares, for models differ by orders.

    Attributes:
        title: of the bar.
        amounts: part (of bytes: family of parts) -> bytes or seconds.
        total_text: the whole, with its unit.
        details: family -> its parts, as the method names them.
    """

    dataset: str
    title: str
    amounts: dict[str, float]
    total_text: str = ""
    details: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def total(self) -> float:
        return sum(self.amounts.values())

    def percent(self, part: str) -> float:
        return 100.0 * self.amounts.get(part, 0.0) / self.total if self.total else 0.0


def ledger(table: pd.DataFrame) -> tuple[list[Whole], list[str]]:
    """Bytes of all scenes and what they share, mean over seeds: the bars, and the families of parts."""
    bars = []
    for axes, rows in table.groupby(_BAR, dropna=False, sort=False):
        # One fit listed twice (under two runs) is one set of bytes.
        rows = _whole_seeds(rows).drop_duplicates(["job", "scene", "part"])
        seeds = max(1, rows["seed"].nunique())
        sums = {
            str(part): float(count) / seeds for part, count in rows.groupby("part")["bytes"].sum().items()
        }
        bar = Whole(str(axes[0]), _title(table, *axes), {}, f"{mib(sum(sums.values()))} MiB")
        for part, count in sums.items():
            family = families.family(part)
            bar.amounts[family] = bar.amounts.get(family, 0.0) + count
            bar.details.setdefault(family, {})[part] = count
        bars.append(bar)
    for family in families.small(bar.amounts for bar in bars) - {OTHER}:
        for bar in bars:
            if family in bar.amounts:
                bar.amounts[OTHER] = bar.amounts.get(OTHER, 0.0) + bar.amounts.pop(family)
                bar.details.setdefault(OTHER, {}).update(bar.details.pop(family))
    return _by_dataset(table, bars), families.ordered(family for bar in bars for family in bar.amounts)


FRAME = "frame"


def timing(table: pd.DataFrame) -> tuple[list[Whole], list[str]]:
    """Seconds of a frame by part, mean over scenes and seeds: the bars, and the parts as they happen.

    Parts are timed one by one: what of the frame they do not explain is :data:`OTHER`.
    """
    bars = []
    for axes, rows in table.groupby(_BAR, dropna=False, sort=False):
        rows = _whole_seeds(rows).drop_duplicates(["job", "part"])
        means = {str(part): float(value) for part, value in rows.groupby("part")["seconds"].mean().items()}
        frame = means.pop(FRAME, 0.0)
        amounts = {part: value for part, value in means.items() if value > 0}
        if not amounts:
            continue
        amounts[OTHER] = max(0.0, frame - sum(amounts.values()))
        whole = frame or sum(amounts.values())
        bars.append(Whole(str(axes[0]), _title(table, *axes), amounts, seconds(whole)))
    return _by_dataset(table, bars), families.ordered(part for bar in bars for part in bar.amounts)


def _whole_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Without seeds that lack scenes which others have."""
    scenes = rows.groupby("seed", dropna=False)["scene"].transform("nunique")
    whole: pd.DataFrame = rows[scenes == scenes.max()]
    return whole


def _by_dataset(table: pd.DataFrame, bars: list[Whole]) -> list[Whole]:
    """The bars of a dataset stand together."""
    order = {str(dataset): i for i, dataset in enumerate(table["dataset"].unique())}
    return sorted(bars, key=lambda bar: order[bar.dataset])


def _title(table: pd.DataFrame, *axes: Any) -> str:
    dataset, method, variant, rate, preset = axes
    words = [str(dataset), label(method, variant, rate)]
    words += [str(preset)] if table["preset"].nunique() > 1 else []
    return " · ".join(words)


def _stacked(bars: list[Whole], names: list[str], title: str, amount: Callable[[float], str]) -> Chart:
    """Shares of wholes by part, a bar per dataset and method with its total; panels of :data:`_MOST_BARS`."""
    shades = families.colors(names)
    room = (max((text_width(bar.total_text) for bar in bars), default=0.0) + 12.0) / _BARS
    ticks = tuple((value, str(value)) for value in range(0, 101, 20))
    x = Axis(title, 0.0, 100.0 / (1.0 - room), ticks=ticks)
    width = _BARS + 20.0 + max((text_width(bar.title) for bar in bars), default=0.0)
    panels = []
    for first in range(0, max(1, len(bars)), _MOST_BARS):
        part, boxes = bars[first : first + _MOST_BARS], []
        for row, bar in enumerate(part):
            start = 0.0
            for family in names:
                if share := bar.percent(family):
                    about = "\n".join([bar.title, f"{family}: {_amounts(bar, family, amount)}"])
                    boxes.append(Bar(row, start, start + share, shades[family], about))
                    start += share
        rows = tuple((row, bar.title) for row, bar in enumerate(part))
        y = Axis("", len(part) - 0.5, -0.5, ticks=rows, grid=False)
        totals = [Text(100.0, row, bar.total_text, INK) for row, bar in enumerate(part)]
        height = 52.0 + 26.0 * len(part)
        panels.append(Panel("", x, y, labels=totals, bars=boxes, width=width, height=height))
    return Chart(panels, {family: Look(shade, "square", "") for family, shade in shades.items()})


def ledger_chart(bars: list[Whole], names: list[str]) -> Chart:
    """Share of the bytes by part."""
    return _stacked(bars, names, "share of size [%]", lambda count: f"{mib(count)} MiB ({count:,.0f} B)")


def timing_chart(bars: list[Whole], names: list[str]) -> Chart:
    """Share of a frame's time by part."""
    return _stacked(bars, names, "share of frame time [%]", lambda clock: f"{1e3 * clock:.3g} ms")


def _amounts(bar: Whole, family: str, amount: Callable[[float], str]) -> str:
    """An amount, and its parts where its name is not the only one."""
    text = amount(bar.amounts.get(family, 0.0))
    details = bar.details.get(family, {})
    if set(details) <= {family}:
        return text
    return "\n".join([text, *(f"{part}: {amount(value)}" for part, value in details.items())])
