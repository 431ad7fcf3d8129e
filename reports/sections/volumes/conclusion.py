"""When a model pays: models of scenes against the compressed volume itself, drawn by the ray marcher."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from econgs_bench.reports.charts.lines import Line
from econgs_bench.reports.curves import Curve, need
from econgs_bench.reports.fronts import interpolated
from econgs_bench.reports.style import MIB, MISSING, Model, absent, mib

if TYPE_CHECKING:
    import pandas as pd

_GRID = re.compile(r"([^@,]+)(?:@(\d+))?(.*)")
"""Name of a field, its grid unless that is the usual one, and what else tells its rows from others."""
VOLUMES = ("sz3", "zfp")
"""Methods that store the volume itself."""
HEADS = (
    "Dataset", "Method", "PSNR [dB]", "Size [MiB]", "Volume", "Its size at that PSNR [MiB]", "Ratio",
    "Volume is better from [MiB]", "View [ms]", "View of the volume [ms]", "Memory [MiB]",
    "Memory of the volume [MiB]",
)  # fmt: skip
"""Of :func:`row`."""


@dataclass(frozen=True)
class Payoff:
    """A model against a compressed volume, at the model's highest PSNR.

    Attributes:
        bytes: of the model, per scene.
        psnr: of the model, dB.
        needed: bytes of the volume at that PSNR.
        bound: "" if ``needed`` is such, "below" or "above" if the volume's curve begins or ends there.
        meeting: bytes from which on the volume has the higher PSNR; None where the curves do not cross.
        grid: name of the field, and N of its N³ samples; None where that is not known.
    """

    dataset: str
    volume: Curve
    model: Curve
    bytes: float
    psnr: float
    needed: float
    bound: str
    meeting: tuple[float, float] | None
    grid: tuple[str, float] | None

    @property
    def panel(self) -> str:
        """Field and volume: the title of its panel over grids; "" where the grid is not known."""
        return f"{self.grid[0]}, {self.volume.title}" if self.grid else ""

    @property
    def pays(self) -> bool:
        """Whether the model is smaller than a volume as good; False where such a volume is not known."""
        return self.smaller is True

    @property
    def smaller(self) -> bool | None:
        """Whether the model is smaller than a volume as good; None if the volume's curve leaves it open."""
        if self.bytes < self.needed:
            return None if self.bound == "below" else True
        return None if self.bound == "above" else False


def sides(dvr: pd.DataFrame) -> dict[str, float]:
    """Dataset -> N of the N³ samples of its volumes, from the table `dvr`: a name may say none."""
    known = dvr[dvr["status"] == "ok"]
    samples = known[["nx", "ny", "nz"]].astype(float).prod(axis=1)
    return dict(zip(known["dataset"], (samples ** (1 / 3)).round(), strict=True))


def payoffs(curves: dict[str, list[Curve]], sides: Mapping[str, float] | None = None) -> list[Payoff]:
    """Of every model against every compressed volume of its dataset, in the drawing nearest the truth.

    Args:
        curves: dataset -> curves.
        sides: :func:`sides` of datasets.
    """
    return [
        _payoff(
            dataset,
            max(drawings, key=lambda one: max(point.psnr for point in one.points)),
            model,
            sides or {},
        )
        for dataset, rows in curves.items()
        for method in VOLUMES
        if (drawings := [one for one in rows if one.model.method == method])
        for model in rows
        if model.model.method not in VOLUMES
    ]


def _payoff(dataset: str, volume: Curve, model: Curve, sides: Mapping[str, float]) -> Payoff:
    best = max(model.points, key=lambda point: point.psnr)
    enough = need(volume, best.psnr)
    needed, bound = volume.points[-1].bytes, "above"
    if enough is not None:
        needed, bound = enough.bytes, "below" if enough.bound else ""
    meeting = _meeting(volume.spots, model.spots)
    grid = _grid(dataset, sides)
    return Payoff(dataset, volume, model, best.bytes, best.psnr, needed, bound, meeting, grid)


def _grid(dataset: str, sides: Mapping[str, float]) -> tuple[str, float] | None:
    found = _GRID.fullmatch(dataset)
    if found is None:
        return None
    name, side, rest = found.groups()
    n = float(side) if side else sides.get(name)
    return None if n is None else (name + rest, n)


def _meeting(
    volume: Sequence[tuple[float, float]], model: Sequence[tuple[float, float]]
) -> tuple[float, float] | None:
    """Where a volume's curve first rises above a model's: bytes, dB. Both are linear over log bytes."""
    low, high = max(volume[0][0], model[0][0]), min(volume[-1][0], model[-1][0])
    sizes = sorted({low, high, *(size for size, _ in (*volume, *model) if low < size < high)})
    for start, end in pairwise(sizes if low < high else []):
        before, after = (interpolated(volume, size) - interpolated(model, size) for size in (start, end))
        if before < 0.0 <= after:
            size = start * (end / start) ** (before / (before - after))
            return size, interpolated(volume, size)
    return None


def memory_and_times(curve: Curve) -> tuple[list[float], list[float]]:
    """MiB and milliseconds a view of the points that have both."""
    both = [
        (point.row["peak_host_bytes"] / MIB, 1e3 / point.row["fps"])
        for point in curve.points
        if not any(absent(point.row.get(name)) for name in ("peak_host_bytes", "fps"))
    ]
    return [memory for memory, _ in both], [time for _, time in both]


def over_grids(found: Sequence[Payoff]) -> dict[str, list[Line]]:
    """Bytes of models over those of the volume at equal PSNR, where a field is measured on several grids.

    Returns:
        Field and volume -> a line per model over N. What the volume's curve does not reach is left out.
    """
    spots: dict[tuple[str, Model], list[tuple[float, float]]] = {}
    for one in found:
        if one.grid and not one.bound:
            line = spots.setdefault((one.panel, one.model.model), [])
            line.append((one.grid[1], one.bytes / one.needed))
    panels: dict[str, list[Line]] = {}
    for (title, model), own in spots.items():
        if len(own) > 1:
            x, y = zip(*sorted(own), strict=True)
            panels.setdefault(title, []).append(Line(model, model.title, list(x), list(y)))
    return panels


def growth(title: str, rows: Sequence[Payoff], lines: Sequence[Line]) -> str | None:
    """From which grid on models are smaller than the volume, and how many of them weigh as much as it.

    Args:
        title: of field and volume.
        rows: of them, on several grids.
        lines: of :func:`over_grids`.

    Returns:
        None where nothing is known of a model on more than one grid.
    """
    cubes = {n: f"{n:,.0f}\N{SUPERSCRIPT THREE}" for n in sorted({one.grid[1] for one in rows if one.grid})}
    crossings = {line.model: _crossing(line) for line in lines}
    found: dict[str, tuple[float, list[str]]] = {}
    for curve in {one.model.model: one.model for one in rows}.values():
        own = sorted(
            (one.grid[1], one.smaller) for one in rows if one.grid and one.model.model == curve.model
        )
        known = [(n, smaller) for n, smaller in own if smaller is not None]
        if len(known) < 2:
            continue
        smaller_on = [n for n, smaller in known if smaller]
        if len(smaller_on) == len(own):
            where, least = "on all", 0.0
        elif not smaller_on:
            where, least = "on none", math.inf
        elif known[-1][1] and (crossing := crossings.get(curve.model)) is not None:
            where, least = f"from about {crossing:,.0f}\N{SUPERSCRIPT THREE} on", crossing
        else:
            where, least = f"on {', '.join(cubes[n] for n in smaller_on)}", smaller_on[0]
        found.setdefault(where, (least, []))[1].append(curve.title)
    if not found:
        return None
    parts = [
        f"{', '.join(names)} {where}"
        for where, (_, names) in sorted(found.items(), key=lambda one: one[1][0])
    ]
    first, *_, last = cubes.values()
    return (
        f"{title}: smaller at equal PSNR, of grids from {first} to {last}: {'; '.join(parts)}.{_weight(rows)}"
    )


def _weight(rows: Sequence[Payoff]) -> str:
    """What the volume weighs on the largest grid, in models; "" where nothing is known of it."""
    side = max(one.grid[1] for one in rows if one.grid)
    largest = [one for one in rows if one.grid and one.grid[1] == side and one.smaller is not None]
    if not largest:
        return ""
    best = min(largest, key=lambda one: (not one.smaller, one.bytes / one.needed))
    least = "at least " if best.bound == "above" else ""
    weighs = (
        f"as much as {least}{best.needed / best.bytes:.1f} models" if best.smaller else "less than one model"
    )
    return f" On the largest grid the volume weighs {weighs} of {best.model.title}."


def _crossing(line: Line) -> float | None:
    """Where a line falls below 1 for good, linear in the logarithms; None if it does not."""
    if line.y[-1] >= 1.0:
        return None
    for (a, high), (b, low) in reversed(list(pairwise(zip(line.x, line.y, strict=True)))):
        if high >= 1.0:
            return float(a * (b / a) ** (math.log(high) / math.log(high / low)))
    return None


def conclusion(found: Sequence[Payoff]) -> list[str]:
    """Which models are smaller than a volume that is as good, by dataset or field, and volume."""
    panels = over_grids(found)
    sentences = []
    for title in dict.fromkeys(one.panel for one in found if one.panel):
        rows = [one for one in found if one.panel == title]
        if len({one.grid for one in rows}) > 1 and (said := growth(title, rows, panels.get(title, []))):
            sentences.append(said)
            found = [one for one in found if one.panel != title]
    for dataset, volume in dict.fromkeys((one.dataset, one.volume.title) for one in found):
        rows = [one for one in found if (one.dataset, one.volume.title) == (dataset, volume)]
        paying = ", ".join(one.model.title for one in rows if one.pays)
        sentences.append(f"{dataset}: {paying or 'no model'} smaller than the {volume} at equal PSNR.")
    return sentences


def row(one: Payoff) -> list[str]:
    """A line of the table, under :data:`HEADS`."""
    sign = {"": "", "below": "\N{LESS-THAN OR EQUAL TO} ", "above": "> "}[one.bound]
    ratio = {"": "", "below": "\N{GREATER-THAN OR EQUAL TO} ", "above": "< "}[one.bound]
    memory, times = (
        [f"{side[-1]:,.1f}" if side else MISSING for side in both]
        for both in zip(memory_and_times(one.model), memory_and_times(one.volume), strict=True)
    )
    return [
        *(one.dataset, one.model.title, f"{one.psnr:.2f}", mib(one.bytes), one.volume.title),
        *(f"{sign}{mib(one.needed)}", f"{ratio}{_digits(one.bytes / one.needed)}"),
        MISSING if one.meeting is None else mib(one.meeting[0]),
        *times,
        *memory,
    ]


def _digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 10.0 else f"{value:.2g}"
