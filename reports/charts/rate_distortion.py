"""Rate-distortion curves, and the average difference of two of them (Bjøntegaard's delta)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from reports.style import MIB, OTHERS, Look, absent, label, look, mean_key, method_of, named
from reports.tables.means import summary
from reports.tables.protocols import comparable, shared_by_all

if TYPE_CHECKING:
    import pandas as pd

LEAST_POINTS = 4
"""Of each curve, for a difference."""
LEAST_OVERLAP = 0.5
"""Less of the common range, as a share of what both curves span, is warned of."""
INTERPOLATION = "Akima"
"""Of log10(bytes) over PSNR and the other way round; steadier than cubic or PCHIP (Herglotz et al. 2024)."""
_DISAGREE = 0.1


@dataclass(frozen=True)
class Point:
    """A model of all scenes of a dataset.

    Attributes:
        rate: value of the knob, "" if it is not named.
        bytes: per scene.
        psnr: mean over scenes, dB.
        row: the summary's row, with the other metrics.
    """

    rate: str
    bytes: float
    psnr: float
    row: dict[str, Any] = field(repr=False, compare=False)

    @property
    def key(self) -> str:
        """Of the table's row."""
        return mean_key(self.row)


@dataclass(frozen=True)
class Curve:
    """A method (with options that are no rate knob) on a dataset; points from the smallest to the largest.

    Attributes:
        dataset: with preset and split where there are several.
        name: of its first row as a series, which decides its color.
        title: what it is called.
    """

    dataset: str
    method: str
    name: str
    title: str
    points: tuple[Point, ...]

    @property
    def mebibytes(self) -> list[float]:
        """Sizes of the points, as charts show them."""
        return [point.bytes / MIB for point in self.points]

    def exchange(self) -> dict[str, Any]:
        """The curve as CompressAI lays out its own: lists of equal length by metric, from small to large.

        ``bytes`` are per scene; a value that was not measured is None.
        """
        metrics = ("psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv", "fps")
        columns: dict[str, list[Any]] = {
            "rate": [point.rate for point in self.points],
            "bytes": [point.bytes for point in self.points],
            "psnr": [point.psnr for point in self.points],
        }
        for name in metrics:
            values = [point.row.get(name) for point in self.points]
            if not all(absent(value) for value in values):
                columns[name] = [None if absent(value) else float(value) for value in values]  # type: ignore[arg-type]
        first = self.points[0].row
        scenes, seeds = _scenes(first), first["seeds"]
        told = f"{first['dataset']}, preset {first['preset']}, {first['split']} views: "
        told += f"means over {scenes} scenes"
        told += "" if seeds == 1 else f" and {seeds} seeds"
        return {"name": self.title, "description": told, "results": columns}

    @property
    def problem(self) -> str:
        """Why no difference can be taken of it; "" if it can."""
        if len(self.points) < LEAST_POINTS:
            return f"{self.title} has {_points(len(self.points))}, {LEAST_POINTS} are needed"
        for a, b in zip(self.points, self.points[1:], strict=False):
            if b.bytes <= a.bytes or b.psnr <= a.psnr:
                return (
                    f"{self.title} is not monotone: {a.psnr:.2f} dB in {a.bytes:,.0f} B, "
                    f"{b.psnr:.2f} dB in {b.bytes:,.0f} B"
                )
        return ""


def at_default_rates(table: pd.DataFrame) -> pd.DataFrame:
    """Without fits that differ only in a rate knob from fits of the same table at its default value.

    Args:
        table: `results`, `curve`, `losses` or `features`.
    """
    import pandas as pd

    fits = list(table[["dataset", "preset", "method", "base"]].itertuples(index=False, name=None))
    at_default = table["knob_value"].isna()
    default = {fit for fit, unset in zip(fits, at_default, strict=True) if unset}
    alone = pd.Series([fit not in default for fit in fits], table.index, dtype=bool)
    rows: pd.DataFrame = table[at_default | alone]
    return rows


def curves(results: pd.DataFrame) -> dict[str, list[Curve]]:
    """Dataset (with preset and split where there are several) -> its curves.

    The points are the rates that one fit was saved at (column ``rate``), or fits that differ only in a rate
    knob (column ``knob_value``); a method of one size is a curve of one point. Sets that lack a
    scene are left out, seeds are averaged: those that all points of a curve have, if there are any, for seeds
    may lie further apart than rates.
    """
    if results.empty:
        return {}
    made: dict[str, list[Curve]] = {}
    columns = results[["method", "variant", "base", "knob_value"]]
    knobs = {(method, variant): rest for method, variant, *rest in columns.itertuples(index=False)}
    for dataset, rows in comparable(summary(with_shared_seeds(results))):
        gathered: dict[tuple[str, str], list[tuple[str, Point]]] = {}
        for _, row in rows[rows["complete"] & rows["psnr"].notna() & (rows["size_bytes"] > 0)].iterrows():
            rest, knob = knobs[row["method"], row["variant"]]
            scenes = _scenes(row)
            rate = knob if absent(row["rate"]) else row["rate"]
            point = Point(
                "" if absent(rate) else f"{rate:g}",
                float(row["size_bytes"]) / scenes,
                float(row["psnr"]),
                dict(row),
            )
            key = (str(row["method"]), rest)
            gathered.setdefault(key, []).append((label(row["method"], row["variant"]), point))
        for (method, rest), found in gathered.items():
            points = _distinct([point for _, point in found])
            made.setdefault(dataset, []).append(
                Curve(dataset, method, found[0][0], label(method, rest), points)
            )
    return made


def with_shared_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Without those seeds of a curve that some of its points lack; as it is where they share none.

    Args:
        results: the documented table.
    """
    import pandas as pd

    points: dict[tuple[Any, ...], dict[tuple[str, str], set[Any]]] = {}
    names = ["dataset", "preset", "split", "method", "base", "variant", "rate", "seed"]
    cells = [
        [None if absent(cell) else cell for cell in row] for row in results[names].itertuples(index=False)
    ]
    for *axes, variant, rate, seed in cells:
        point = points.setdefault(tuple(axes), {})
        point.setdefault((str(variant), str(rate)), set()).add(seed)
    shared = {curve: shared_by_all(found.values()) for curve, found in points.items()}
    kept = [seed in shared[tuple(axes)] for *axes, _, _, seed in cells]
    return results[pd.Series(kept, results.index, dtype=bool)]


def _scenes(row: Any) -> int:
    """Number of scenes of a complete row of the summary."""
    return len(row["jobs"]) // int(row["seeds"])


def _distinct(points: list[Point]) -> tuple[Point, ...]:
    """By bytes. The default's model is left out where the knob's value that it is was measured too."""
    ordered = sorted(points, key=lambda point: (point.bytes, point.psnr, not point.rate))
    return tuple(
        point
        for i, point in enumerate(ordered)
        if i == 0 or (point.bytes, point.psnr) != (ordered[i - 1].bytes, ordered[i - 1].psnr)
    )


@dataclass(frozen=True)
class Difference:
    """Two curves compared; what could not be computed is None.

    Curves may share PSNR and no sizes (a method that takes a third of the bytes), or sizes and no PSNR.

    Attributes:
        rate: BD-rate: bytes of ``test`` at equal PSNR, in percent of those of ``reference``, minus 100.
        psnr: BD-PSNR: dB that ``test`` is above ``reference`` at equal bytes.
        psnr_range: the PSNR, in dB, over which ``rate`` is an average.
        bytes_range: the bytes per scene over which ``psnr`` is an average.
        overlap: share of the two curves' PSNR and of their log bytes that is common; the smaller of both, of
            those that are.
        warnings: what makes the numbers doubtful, or why one is not there.
        refused: why neither is there.
    """

    dataset: str
    reference: str
    test: str
    rate: float | None = None
    psnr: float | None = None
    psnr_range: tuple[float, float] | None = None
    bytes_range: tuple[float, float] | None = None
    overlap: float = 0.0
    warnings: tuple[str, ...] = ()
    refused: str = ""


def difference(reference: Curve, test: Curve) -> Difference:
    """BD-rate and BD-PSNR of a curve against another (Bjøntegaard 2001, VCEG-M33)."""
    import numpy as np

    who = (reference.dataset, reference.title, test.title)
    if refused := "; ".join(filter(None, (reference.problem, test.problem))):
        return Difference(*who, refused=refused)
    quality = [[point.psnr for point in curve.points] for curve in (reference, test)]
    size = [[point.bytes for point in curve.points] for curve in (reference, test)]
    common, by_quality = _overlap(*quality)
    common_log, by_size = _overlap(*(list(np.log10(values)) for values in size))
    doubts = []
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
    return Difference(*who, rate, psnr, common, ends, overlap, tuple(doubts))


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


def differences(curves: dict[str, list[Curve]]) -> list[Difference]:
    """Of all pairs of a dataset's curves that have several points, each against those before it."""
    return [
        difference(reference, test)
        for rows in curves.values()
        for drawn in ([curve for curve in rows if len(curve.points) > 1],)
        for i, test in enumerate(drawn)
        for reference in drawn[:i]
    ]


def _points(count: int) -> str:
    return "one point" if count == 1 else f"{count} points"


def drawn(curves: dict[str, list[Curve]]) -> dict[str, list[Curve]]:
    """What a chart shows of the datasets on which some method was measured at several rates.

    Those methods, and of the others the default settings (the first where there are none): single sizes of
    all variants are what the trade-off charts are for.
    """
    made = {}
    for dataset, rows in curves.items():
        titles = {curve.title for curve in rows if len(curve.points) > 1}
        if not titles:
            continue
        seen = {method_of(title) for title in titles}
        for curve in sorted(rows, key=lambda curve: curve.title != method_of(curve.title)):
            method = method_of(curve.title)
            if curve.title == method or method not in seen:
                titles.add(curve.title)
                seen.add(method)
        made[dataset] = [curve for curve in rows if curve.title in titles]
    return made


def looks(curves: list[Curve], names: list[str]) -> list[tuple[Curve, Look]]:
    """The curves of a panel with their looks, gray ones first."""
    told = named(curve.title for curve in curves)
    pairs = [(curve, look(curve.name, names) if curve.title in told else OTHERS) for curve in curves]
    return sorted(pairs, key=lambda pair: pair[1] is not OTHERS)


def labels(
    curves: list[Curve], names: list[str]
) -> tuple[list[tuple[float, float, str, str]], list[tuple[float, float]]]:
    """(x in MiB, y, text, color) at each named curve's right end, and points along all to keep clear of."""
    import numpy as np

    ends, along = [], []
    for curve, style in looks(curves, names):
        x, y = np.array(curve.mebibytes), np.array([point.psnr for point in curve.points])
        if style is not OTHERS:
            ends.append((float(x[-1]), float(y[-1]), curve.title, style.color))
        at = np.geomspace(x[0], x[-1], 40) if len(x) > 1 else x
        along += list(zip(map(float, at), map(float, np.interp(np.log(at), np.log(x), y)), strict=True))
    return ends, along
