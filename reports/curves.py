"""Rate-distortion curves of methods."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.fronts import pareto
from econgs_bench.reports.schema import records
from econgs_bench.reports.style import Model, absent, mean_key, model
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.protocols import comparable, of_shared_seeds

if TYPE_CHECKING:
    import pandas as pd

LEAST_POINTS = 4
"""Of each curve, for a difference."""


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
        model: without the rate knob.
    """

    dataset: str
    model: Model
    points: tuple[Point, ...]

    @property
    def title(self) -> str:
        """What it is called."""
        return self.model.title

    @property
    def spots(self) -> list[tuple[float, float]]:
        """Bytes and PSNR of the points."""
        return [(point.bytes, point.psnr) for point in self.points]

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
        words = f"{first['dataset']}, preset {first['preset']}, {first['split']} views: "
        words += f"means over {scenes} scenes"
        words += "" if seeds == 1 else f" and {seeds} seeds"
        return {"name": self.title, "description": words, "results": columns}

    @cached_property
    def front(self) -> tuple[Point, ...]:
        """The points that no other one beats in bytes and PSNR: what a difference is taken of.

        Rates may be codecs, of which one is worse than another, and the largest model is not always the best.
        """
        spots = set(pareto(self.spots, -1))
        return tuple(point for point in self.points if (point.bytes, point.psnr) in spots)

    @property
    def problem(self) -> str:
        """Why no difference can be taken of it; "" if it can."""
        if len(self.front) >= LEAST_POINTS:
            return ""
        where = " on its front" if self._beaten else ""
        return f"{self.title} has {_points(len(self.front))}{where}, {LEAST_POINTS} are needed"

    @property
    def doubt(self) -> str:
        """What of it a difference leaves out; "" if nothing."""
        beaten = self._beaten
        return f"{self.title} without {_points(beaten)} that others of its own beat" if beaten else ""

    @property
    def _beaten(self) -> int:
        return len(self.points) - len(self.front)


@dataclass(frozen=True)
class Need:
    """What a model takes for a quality.

    Attributes:
        bytes: of the model.
        primitives: of the model; NaN where its row does not say.
        bound: the smallest model is above that quality: these are its, and less may do.
    """

    bytes: float
    primitives: float
    bound: bool = False


def need(curve: Curve, level: float) -> Need | None:
    """What the first model of a curve that reaches a quality takes, logarithms linear in dB between points.

    Nothing is extrapolated: None where the quality is never reached.
    """
    smallest = curve.points[0]
    if smallest.psnr >= level:
        return Need(smallest.bytes, _primitives(smallest), smallest.psnr > level)
    for below, above in pairwise(curve.points):
        if above.psnr >= level:  # the first that is
            share = (level - below.psnr) / (above.psnr - below.psnr)
            return Need(
                _between(below.bytes, above.bytes, share),
                _between(_primitives(below), _primitives(above), share),
            )
    return None


def _primitives(point: Point) -> float:
    """NaN where the row does not say."""
    primitives = point.row.get("primitives")
    return math.nan if primitives is None else float(primitives)


def _between(low: float, high: float, share: float) -> float:
    if min(low, high) <= 0.0:  # an empty model has no logarithm
        return low + share * (high - low)
    return float(low * (high / low) ** share)


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
    knob (column ``knob_value``); a method of one size is a curve of one point. Seeds are averaged. Models
    that lack scenes are compared with all others on the scenes that they have, in a panel of its own where
    they have several points.

    Args:
        results: of the seeds that :func:`with_shared_seeds` leaves.
    """
    panels: dict[str, list[Curve]] = {}
    columns = results[["method", "variant", "base", "knob_value"]]
    knobs = {(method, variant): rest for method, variant, *rest in columns.itertuples(index=False)}
    basic = results[results["kind"] == "basic"]
    for dataset, rows in comparable(basic):
        every = _curves(dataset, rows, knobs)
        if every:
            panels[dataset] = every
        whole = {curve.model for curve in every}
        for scenes in _fewer_scenes(rows):
            names = ", ".join(sorted(scenes))
            title = (
                f"{dataset} / {names}" if len(scenes) == 1 else f"{dataset}, {len(scenes)} scenes: {names}"
            )
            found = _curves(title, rows[rows["scene"].isin(scenes)], knobs)
            if any(len(curve.points) > 1 and curve.model not in whole for curve in found):
                panels[title] = found
                whole |= {curve.model for curve in found}
    return panels


def _curves(title: str, results: pd.DataFrame, knobs: Mapping[tuple[Any, Any], Sequence[Any]]) -> list[Curve]:
    """The curves of the models that have all scenes of some results."""
    groups: dict[Model, list[Point]] = {}
    rows = summary(results)
    for row in records(rows[rows["complete"] & rows["psnr"].notna() & (rows["size_bytes"] > 0)]):
        base, knob = knobs[row["method"], row["variant"]]
        rate = knob if absent(row["rate"]) else row["rate"]
        size = float(row["size_bytes"]) / _scenes(row)
        point = Point("" if absent(rate) else f"{rate:g}", size, float(row["psnr"]), row)
        groups.setdefault(model(row["method"], base), []).append(point)
    return [Curve(title, each, _distinct(group)) for each, group in groups.items()]


def _fewer_scenes(results: pd.DataFrame) -> list[frozenset[str]]:
    """The sets of scenes that models have with all their seeds, but for the set of all; large first."""
    fits: dict[tuple[Any, ...], dict[Any, set[str]]] = {}
    columns = (results[name].tolist() for name in ("method", "variant", "rate", "seed", "scene", "status"))
    for method, variant, rate, seed, scene, status in zip(*columns, strict=True):
        own = fits.setdefault((method, variant, None if absent(rate) else rate), {}).setdefault(seed, set())
        if status == "ok":
            own.add(str(scene))
    sets = {frozenset(set.intersection(*seeds.values())) for seeds in fits.values()}
    every = frozenset(str(scene) for scene in results["scene"])
    return sorted((one for one in sets if one and one != every), key=lambda one: (-len(one), sorted(one)))


def with_shared_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Without those seeds of a curve that some of its points lack; as it is where they share none.

    Seeds may lie further apart than rates.

    Args:
        results: the documented table.
    """
    return of_shared_seeds(results, ("dataset", "preset", "split", "method", "base"), ("variant", "rate"))


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


def _points(count: int) -> str:
    return "one point" if count == 1 else f"{count} points"
