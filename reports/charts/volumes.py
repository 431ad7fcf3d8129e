"""When a model pays: models of scenes beside the compressed volume itself, drawn by the ray marcher."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TYPE_CHECKING

from reports.charts.chart import INK, Chart, Panel, Series, Text, linear_axis, log_axis
from reports.charts.elements import Section, cards, table
from reports.fronts import interpolated
from reports.style import MIB, MISSING, Look, Model, absent, looks, mib

if TYPE_CHECKING:
    from reports.charts.rate_distortion import Curve
    from reports.charts.report import Report

VOLUMES = ("sz3", "zfp")
"""Methods that store the volume itself."""
HEADS = (
    "Dataset", "Method", "PSNR [dB]", "Size [MiB]", "Volume", "Its size at that PSNR [MiB]", "Ratio",
    "Volume is better from [MiB]", "View [ms]", "View of the volume [ms]", "Memory [MiB]",
    "Memory of the volume [MiB]",
)  # fmt: skip
"""Of :func:`row`."""
_ABOVE = 6.0
"""dB of the volumes' curves that a chart shows above all models: without loss they go to 90 dB and more."""
_WORDS = (
    "Left: mean PSNR of the pictures over size per scene, of models and of the volume itself, compressed, "
    "whose curve is cut a little above the best model; a black cross stands where a curve of the volume "
    "passes that of a model, which pays at smaller sizes only. Right: time of a view over memory, at all "
    "rates. The volume is drawn by the marcher that drew the ground truth, so its error is that of the "
    "compression alone, which favours it, and it takes every other transfer function without more bytes. "
    "Its size is shared by the scenes of a variable."
)


@dataclass(frozen=True)
class Verdict:
    """A model against a compressed volume, at the model's highest PSNR.

    Attributes:
        bytes: of the model, per scene.
        psnr: of the model, dB.
        needed: bytes of the volume at that PSNR.
        bound: "" if ``needed`` is such, "below" or "above" if the volume's curve begins or ends there.
        meeting: bytes from which on the volume has the higher PSNR; None where the curves do not cross.
    """

    dataset: str
    volume: Curve
    model: Curve
    bytes: float
    psnr: float
    needed: float
    bound: str
    meeting: tuple[float, float] | None

    @property
    def pays(self) -> bool:
        """Whether the model is surely smaller than a volume as good."""
        return self.bytes < self.needed and self.bound != "below"


def verdicts(curves: dict[str, list[Curve]]) -> list[Verdict]:
    """Of every model against every compressed volume of its dataset."""
    return [
        _verdict(dataset, volume, model)
        for dataset, rows in curves.items()
        for volume in rows
        if volume.model.method in VOLUMES
        for model in rows
        if model.model.method not in VOLUMES
    ]


def _verdict(dataset: str, volume: Curve, model: Curve) -> Verdict:
    best = max(model.points, key=lambda point: point.psnr)
    spots = _spots(volume)
    needed, bound = spots[0][0], "below"
    if best.psnr > spots[0][1]:
        needed, bound = spots[-1][0], "above"
        for (low, worse), (high, better) in pairwise(spots):
            if worse < best.psnr <= better:
                share = (best.psnr - worse) / (better - worse)
                needed, bound = low * (high / low) ** share, ""
                break
    return Verdict(
        dataset, volume, model, best.bytes, best.psnr, needed, bound, _meeting(spots, _spots(model))
    )


def _spots(curve: Curve) -> list[tuple[float, float]]:
    return [(point.bytes, point.psnr) for point in curve.points]


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


def volumes_chart(curves: dict[str, list[Curve]], found: Sequence[Verdict], models: list[Model]) -> Chart:
    """Two panels of each dataset with a volume and a model: PSNR over size, time of a view over memory."""
    panels = []
    for dataset in dict.fromkeys(one.dataset for one in found):
        rows = curves[dataset]
        styles = looks({curve.model: curve.first for curve in rows}, models)
        most = max(one.psnr for one in found if one.dataset == dataset) + _ABOVE
        lines = {curve.model: (curve, list(_below(_spots(curve), most))) for curve in rows}
        series, labels = [], []
        for each, look in styles.items():
            curve, spots = lines[each]
            if not spots:
                continue
            across, up = [size / MIB for size, _ in spots], [psnr for _, psnr in spots]
            series.append(Series(curve.title, across, up, look._replace(dash="solid"), 1.6, 7.0))
            labels.append(Text(across[-1], up[-1], curve.title, look.color))
        crossings = [one for one in found if one.dataset == dataset and one.meeting is not None]
        for one in crossings:
            assert one.meeting is not None
            name = f"{one.volume.title} passes {one.model.title}"
            spot = [one.meeting[0] / MIB], [one.meeting[1]]
            series.append(Series(name, *spot, Look(INK, "x", ""), mark=9.0, names=[""]))
        x = log_axis([value for one in series for value in one.x], "size per scene [MiB]")
        y = linear_axis([value for one in series for value in one.y], "PSNR [dB]", least=2.0)
        panels.append(Panel(dataset, x, y, series, labels, along=True))
        if costs := _costs(dataset, rows, styles):
            panels.append(costs)
    return Chart(panels)


def _below(spots: Sequence[tuple[float, float]], most: float) -> Iterator[tuple[float, float]]:
    """A curve up to a PSNR."""
    for i, (size, psnr) in enumerate(spots):
        if psnr <= most:
            yield size, psnr
            continue
        if i:
            before, worse = spots[i - 1]
            yield before * (size / before) ** ((most - worse) / (psnr - worse)), most
        return


def _costs(dataset: str, rows: Sequence[Curve], styles: dict[Model, Look]) -> Panel | None:
    """Milliseconds of a view over memory, a mark for each rate."""
    series, labels = [], []
    for curve in sorted(rows, key=lambda curve: list(styles).index(curve.model)):
        memory, times = _memory_and_times(curve)
        if memory:
            look = styles[curve.model]
            series.append(Series(curve.title, memory, times, look, mark=7.0, names=[""] * len(times)))
            labels.append(Text(memory[-1], times[-1], curve.title, look.color))
    if not series:
        return None
    x = log_axis([value for one in series for value in one.x], "host memory [MiB]")
    y = log_axis([value for one in series for value in one.y], "time of a view [ms]")
    return Panel(f"{dataset}, costs", x, y, series, labels)


def _memory_and_times(curve: Curve) -> tuple[list[float], list[float]]:
    """MiB and milliseconds a view of the points that have both."""
    both = [
        (point.row["peak_host_bytes"] / MIB, 1e3 / point.row["fps"])
        for point in curve.points
        if not any(absent(point.row.get(name)) for name in ("peak_host_bytes", "fps"))
    ]
    return [memory for memory, _ in both], [time for _, time in both]


def volumes_section(report: Report) -> Section | None:
    """Models beside the compressed volume; None where there are not both."""
    found = verdicts(report.curves)
    if not found:
        return None
    chart = volumes_chart(report.curves, found, report.models)
    html = (
        f"<p><b>{escape(conclusion(found))}</b></p><p>{_WORDS}</p>{cards(chart.panels)}"
        f"{table('Models and the volume at equal PSNR', HEADS, [row(one) for one in found])}"
    )
    return Section("volumes", "When does a model pay", html, {"volumes": chart})


def conclusion(found: Sequence[Verdict]) -> str:
    """Which models are smaller than a volume that is as good, by dataset and volume."""
    sentences = []
    for dataset, volume in dict.fromkeys((one.dataset, one.volume.title) for one in found):
        rows = [one for one in found if (one.dataset, one.volume.title) == (dataset, volume)]
        paying = ", ".join(one.model.title for one in rows if one.pays)
        sentences.append(f"{dataset}: {paying or 'no model'} smaller than the {volume} at equal PSNR.")
    return " ".join(sentences)


def row(one: Verdict) -> list[str]:
    """A line of the table, under :data:`HEADS`."""
    sign = {"": "", "below": "\N{LESS-THAN OR EQUAL TO} ", "above": "> "}[one.bound]
    ratio = {"": "", "below": "\N{GREATER-THAN OR EQUAL TO} ", "above": "< "}[one.bound]
    memory, times = (
        [f"{side[-1]:,.1f}" if side else MISSING for side in both]
        for both in zip(_memory_and_times(one.model), _memory_and_times(one.volume), strict=True)
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
