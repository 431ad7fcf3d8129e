"""One look for all charts: colors that the color-blind can tell apart, names, units, label places."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pandas as pd

# Okabe & Ito (2008) without its yellow, which is too pale on white; black last.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F", "#000000")
MARKERS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "star", "x", "cross")
DASHES = ("solid", "dash", "dot", "dashdot")
# For parts of a whole (the size ledger): muted, so that they are not taken for methods.
PARTS = ("#4C6A92", "#A7BBD1", "#B5838D", "#E5C1BD", "#6D8B74", "#C9D7B8", "#8D7B68", "#D9CBB3", "#999999")
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


def row_key(dataset: Any, scene: Any, method: Any, variant: Any = "", rate: Any = None) -> str:
    """What links a row of the page's table to its points in charts; the scene is "" for a dataset's means."""
    return f"{dataset} / {scene} / {label(method, variant, rate)}"


def series(*tables: pd.DataFrame) -> list[str]:
    """The names (method with variant) of tables, in order of appearance; their index picks the color."""
    names: dict[str, None] = {}
    for table in tables:
        rows = zip(table["method"], table["variant"], strict=True)
        names.update(dict.fromkeys(label(method, variant) for method, variant in rows))
    return list(names)


def color(name: str, names: Sequence[str]) -> str:
    """A series' color: by its place among all series of the report, so it is the same in every chart."""
    return PALETTE[list(names).index(name) % len(PALETTE)]


def marker(name: str, names: Sequence[str]) -> str:
    """A series' marker, in plotly's names; differs where the colors begin again."""
    index = list(names).index(name)
    return MARKERS[(index + index // len(PALETTE)) % len(MARKERS)]


def dash(name: str, names: Sequence[str]) -> str:
    """A series' line, in plotly's names; differs where the colors begin again."""
    return DASHES[list(names).index(name) // len(PALETTE) % len(DASHES)]


class Label(NamedTuple):
    """Where a label goes: offset in pixels from its point (y up), and its text's anchor."""

    dx: float
    dy: float
    anchor: str


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
    """Place labels beside their points without overlaps, greedily.

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
        long = char * len(text)
        for step in range(12):
            lift = line * ((step + 1) // 2) * (1 if step % 2 else -1)
            for anchor in ("left", "right", "center"):
                if anchor == "center" and step == 0:
                    continue
                dx = {"left": 9.0, "right": -9.0, "center": 0.0}[anchor]
                left = x + dx - {"left": 0.0, "right": long, "center": long / 2}[anchor]
                box = (left, y + lift - line / 2, left + long, y + lift + line / 2)
                outside = max(0.0, -box[0]) + max(0.0, box[2] - width)
                outside += max(0.0, -box[1]) + max(0.0, box[3] - height)
                cost = 50.0 * outside + abs(lift) + sum(100.0 * _overlap(box, other) for other in taken)
                if best is None or cost < best[0]:
                    best = (cost, Label(dx, lift, anchor), box)
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
    step = max(1, round((high - low) / 6))
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
