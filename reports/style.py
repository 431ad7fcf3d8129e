"""One look for all charts: colors that the color-blind can tell apart, names, units, label places."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pandas as pd

# Okabe & Ito (2008) without its yellow, which is too pale on white; black last.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F", "#000000")
DARK = {"#000000": "#ffffff", "#0072B2": "#4ba3dc", "#D55E00": "#f2803a"}
"""What would drown on dark -> what stands there instead; the page's script has the same."""
MARKERS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "star", "x", "cross")
DASHES = ("solid", "dash", "dot", "dashdot")
MOST_NAMED = 10
"""Series of a panel; of more, only each method's default has its color and name."""
MIB = float(2**20)
MISSING = "\N{EN DASH}"
TITLES = {
    "3dgs": "3DGS", "econgs": "ECoNGS", "scaffold-gs": "Scaffold-GS", "hac": "HAC", "ivr-gs": "iVR-GS",
    "vq-3dgs": "VQ-3DGS", "plenoxels": "Plenoxels", "ccnerf": "CCNeRF", "veg": "VEG",
    "triangle-mesh": "Triangle mesh",
}  # fmt: skip


def absent(value: Any) -> bool:
    """Whether a cell of a table is missing (None, NaN or pandas' NA)."""
    import pandas as pd

    return value is None or value is pd.NA or (isinstance(value, float) and math.isnan(value))


def label(method: Any, variant: Any = "", rate: Any = None) -> str:
    """What a row is called in tables and charts."""
    parts = [TITLES.get(str(method), str(method))]
    if not absent(variant) and variant:
        parts.append(f"[{variant}]")
    if not absent(rate):
        parts.append(f"@ {rate:g}")
    return " ".join(parts)


def mean_key(row: Any) -> str:
    """What links a row of means in the page's table to its points in charts; a scene's row has its job."""
    name = label(row["method"], row["variant"], row["rate"])
    return " / ".join([str(row["dataset"]), name, str(row["preset"]), str(row["split"])])


def series(*tables: pd.DataFrame) -> list[str]:
    """The names (method with variant) of tables, in order of appearance, which picks their looks."""
    names: dict[str, None] = {}
    for table in tables:
        rows = zip(table["method"], table["variant"], strict=True)
        names.update(dict.fromkeys(label(method, variant) for method, variant in rows))
    return list(names)


def method_of(name: str) -> str:
    """A series' name without its variant; names of default settings are their methods'."""
    return name.partition(" [")[0]


def options_of(name: str) -> str:
    """What tells a series from the default; "" for the default."""
    return name.partition(" [")[2].removesuffix("]")


class Look(NamedTuple):
    """How a series is drawn: color, and marker and line in plotly's names."""

    color: str
    marker: str
    dash: str


OTHERS = Look("#A6A6A6", "circle", "solid")
"""Of series that are not told apart."""
OTHERS_NAME = "other variants"


def look(name: str, names: Sequence[str]) -> Look:
    """The color is the method's, the same in every chart of a report; variants differ in marker and line.

    Args:
        name: a series.
        names: all of the report (:func:`series`).
    """
    methods = list(dict.fromkeys(map(method_of, names)))
    place = {method: i % len(PALETTE) for i, method in enumerate(methods)}
    hue = place[method_of(name)]
    alike = [other for other in names if place[method_of(other)] == hue]
    rank = sorted(alike, key=lambda other: other != method_of(other)).index(name)
    turn = rank + rank // len(MARKERS)  # so that marker and line repeat together late
    return Look(PALETTE[hue], MARKERS[(hue + rank) % len(MARKERS)], DASHES[turn % len(DASHES)])


def color(name: str, names: Sequence[str]) -> str:
    """Of :func:`look`."""
    return look(name, names).color


def named(names: Iterable[str]) -> set[str]:
    """Those series of a panel that are told apart.

    All up to :data:`MOST_NAMED`; of more, one per method: its default, or the first where it has none.
    """
    every = list(dict.fromkeys(names))
    if len(every) <= MOST_NAMED:
        return set(every)
    chosen: dict[str, str] = {}
    for name in sorted(every, key=lambda name: name != method_of(name)):
        chosen.setdefault(method_of(name), name)
    return set(chosen.values())


def looks(drawn: Iterable[str], names: Sequence[str]) -> dict[str, Look]:
    """Series of a panel -> its look; those that are not told apart come first, to be drawn below."""
    every = list(dict.fromkeys(drawn))
    told = named(every)
    ordered = sorted(every, key=lambda name: name in told)
    return {name: look(name, names) if name in told else OTHERS for name in ordered}


def legend_entries(panels: Iterable[Iterable[str]], names: Sequence[str]) -> dict[str, Look]:
    """What a legend of panels names: what they draw, in the order of the report; the gray ones together."""
    drawn: dict[str, Look] = {}
    for panel in panels:
        for name, style in looks(panel, names).items():
            if style is not OTHERS or name not in drawn:
                drawn[name] = style
    entries = {name: drawn[name] for name in names if drawn.get(name, OTHERS) is not OTHERS}
    return entries | ({OTHERS_NAME: OTHERS} if OTHERS in drawn.values() else {})


_LIFTS = 24
"""Heights at which a label is tried."""
FAR = 1.5
"""Lines of text above or below its point beyond which a label has a line to it."""


class Label(NamedTuple):
    """Where a label goes: offset in pixels from its point (y up), its anchor, and the text in lines."""

    dx: float
    dy: float
    anchor: str
    text: str


def place_labels(
    points: Sequence[tuple[float, float]],
    texts: Sequence[str],
    width: float,
    height: float,
    *,
    avoid: Iterable[tuple[float, float]] = (),
    char: float = 6.4,
    line: float = 14.0,
) -> list[Label]:
    """Place labels beside their points without overlaps, greedily; those wider than half the axes are broken.

    Args:
        points: positions in pixels from the lower left corner of the axes.
        texts: one per point.
        width: of the axes in pixels.
        height: of the axes in pixels.
        avoid: further points that no label should cover.
        char: width of a character in pixels.
        line: height of a line in pixels.
    """
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in (*points, *avoid)]
    places: list[Label] = []
    for (x, y), text in zip(points, texts, strict=True):
        best: tuple[float, Label, tuple[float, float, float, float]] | None = None
        lines = textwrap.wrap(text, int(width / char / 2), break_long_words=False, break_on_hyphens=False)
        long, tall = char * max(map(len, lines)), line * len(lines)
        for step in range(_LIFTS):
            lift = line * ((step + 1) // 2) * (1 if step % 2 else -1)
            for anchor in ("left", "right", "center"):
                if anchor == "center" and step == 0:
                    continue
                dx = {"left": 9.0, "right": -9.0, "center": 0.0}[anchor]
                left = x + dx - {"left": 0.0, "right": long, "center": long / 2}[anchor]
                box = (left, y + lift - tall / 2, left + long, y + lift + tall / 2)
                outside = max(0.0, -box[0]) + max(0.0, box[2] - width)
                outside += max(0.0, -box[1]) + max(0.0, box[3] - height)
                cost = 3000.0 * outside + abs(lift)
                if best is not None and cost >= best[0]:
                    continue
                cost += sum(100.0 * _overlap(box, other) for other in taken)
                if best is None or cost < best[0]:
                    best = (cost, Label(dx, lift, anchor, "\n".join(lines)), box)
        assert best is not None
        places.append(best[1])
        taken.append(best[2])
    return places


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def log_range(values: Iterable[float]) -> tuple[float, float]:
    """Ends (as powers of ten) of a logarithmic axis that shows all values with room for labels."""
    logs = [math.log10(v) for v in values if v > 0]
    if not logs:
        return -1.0, 1.0
    low, high = min(logs), max(logs)
    room = max(0.4, 0.22 * (high - low))
    return low - room, high + room


def log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Ticks (value, text) of a logarithmic axis from 10**low to 10**high: 1, 2, 5, or decades only."""
    digits = (1, 2, 5) if high - low < 1.8 else (1,)
    step = max(1, round((high - low) / 3.5))
    ticks = []
    for power in range(math.floor(low), math.ceil(high) + 1):
        for digit in digits:
            value = digit * 10.0**power
            if low <= math.log10(value) <= high and (len(digits) > 1 or power % step == 0):
                ticks.append((value, f"{value:,.{max(0, -power)}f}"))
    return ticks


def linear_range(values: Iterable[float], least: float) -> tuple[float, float]:
    """Ends of a linear axis: the values with a margin, at least ``least`` wide."""
    known = list(values)
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    pad = max(0.12 * (high - low), (least - (high - low)) / 2)
    return low - pad, high + pad


def seconds(value: float) -> str:
    """A duration for people: "4.2 ms", "0.42 s", "12.3 s", "3 min 20 s", "1 h 05 min"."""
    if value < 0.0995:
        return f"{value * 1e3:.1f} ms"
    if value < 9.995:
        return f"{value:.2f} s"
    if value < 60:
        return f"{value:.1f} s" if value < 59.95 else "1 min 00 s"
    whole = round(value)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def mib(value: float) -> str:
    """Bytes as MiB with three significant digits (paper tables: MB = MiB)."""
    size = value / MIB
    if size >= 100:
        return f"{size:,.0f}"
    return f"{size:.1f}" if size >= 10 else f"{size:.2f}" if size >= 0.1 else f"{size:.4f}"
