"""What the charts of training draw: convergence, anytime curves, time to a quality, parts of the loss.

Of fits that differ only in a rate knob they draw the default's: others are points of rate-distortion curves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.style import MIB, Model, model, models, named
from econgs_bench.reports.tables.columns import places
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

LEVELS = (30.0, 32.0, 34.0)
"""Levels of PSNR, dB, whose times are reported."""
_UNIT = {"psnr": 1.0, "bytes_estimate": MIB}
_FIT = ["job", "method", "variant", "seed", "scene"]
MOST_FITS = 24
"""Lines of a chart of convergence: the four scenes of six methods."""
LEAST_SHARE = 1e-5
"""Parts that never reach this share of the loss are not drawn."""


_SHORT = 0.25
"""Stretches shorter than this, against a fit's longest, are left out."""
_NEAR = 0.02
"""Stages that begin nearer to each other than this share of a fit share a mark."""
MARKED = 16
"""Points up to which a line of losses has marks at them."""


@dataclass(frozen=True)
class Curve:
    """A line of a chart.

    Attributes:
        model: whose, which decides the color.
        title: its label.
        x: ascending.
        y: one per x.
    """

    model: Model
    title: str
    x: list[float]
    y: list[float]


def convergence(curve: pd.DataFrame, against: str) -> dict[str, list[Curve]]:
    """Dataset (with its preset where there are several) -> PSNR of each scene while its fit went on.

    Of more than :data:`MOST_FITS` fits the mean of each method's.

    Args:
        curve: the documented table.
        against: "train_seconds" or "iteration".
    """
    panels: dict[str, list[Curve]] = {}
    for title, every in comparable(at_default_rates(curve)):
        rows = every[every["psnr"].notna() & every[against].notna()]
        several = len(models(rows)) > 1
        many = {axis: rows[axis].nunique() > 1 for axis in ("scene", "seed")}
        iteration, x, y = (rows[name].to_numpy(float) for name in ("iteration", against, "psnr"))
        for (_, method, variant, seed, scene), fit in places(rows, _FIT).items():
            mine = model(method, variant)
            words = [mine.title] if several else []
            words += [str(scene)] if many["scene"] or not words else []
            words += [f"seed {seed}"] if many["seed"] else []
            fit = fit[np.argsort(iteration[fit], kind="stable")]
            name = " \N{MIDDLE DOT} ".join(words)
            panels.setdefault(title, []).append(Curve(mine, name, x[fit].tolist(), y[fit].tolist()))
        if len(panels.get(title, [])) > MOST_FITS:
            panels[title] = _of_methods(panels[title])
    return panels


def _of_methods(fits: list[Curve]) -> list[Curve]:
    """Their means by method."""
    by_model: dict[Model, list[Curve]] = {}
    for fit in fits:
        by_model.setdefault(fit.model, []).append(fit)
    return [
        Curve(each, each.title, *_mean([(fit.x, fit.y, 1) for fit in group]))
        for each, group in by_model.items()
    ]


def anytime(curve: pd.DataFrame, results: pd.DataFrame, what: str) -> dict[str, list[Curve]]:
    """As :func:`convergence`, but a curve per method over seconds per scene; mean over scenes and seeds.

    A fit of n scenes counts for each of them with its time / n (and its bytes / n), as in `results`, so that
    joint and single fits compare. A mean begins where all fits have been evaluated; a finished fit keeps its
    last value.

    Args:
        curve: the documented table.
        results: the documented table: which scenes there are, so that a mean of fewer is titled so.
        what: "psnr" or "bytes_estimate" (in MiB).
    """
    panels: dict[str, list[Curve]] = {}
    for panel, every in comparable(at_default_rates(curve)):
        columns = ["job", "method", "variant", "scene", "iteration", "train_seconds", what]
        evaluations = every.loc[every[what].notna() & every["train_seconds"].notna(), columns]
        first = every.iloc[0]
        basic = (results["kind"] == "basic") & (results["dataset"] == first["dataset"])
        scenes = set(results.loc[basic & (results["preset"] == first["preset"]), "scene"])
        for names, rows in evaluations.groupby(["method", "variant"], dropna=False, sort=False):
            scene, *numbers = (
                rows[name].to_numpy() for name in ("scene", "iteration", "train_seconds", what)
            )
            iteration, seconds, values = (column.astype(float) for column in numbers)
            x, y = _mean(
                [
                    _shares(len(set(scene[fit])), iteration[fit], seconds[fit], values[fit], what)
                    for fit in places(rows, ["job"]).values()
                ]
            )
            if not x:
                continue
            mine = model(*names)
            have = scenes & set(rows["scene"])
            missing = f" ({len(have)} of {len(scenes)} scenes)" if scenes - have else ""
            panels.setdefault(panel, []).append(Curve(mine, mine.title + missing, x, y))
    return panels


def _shares(
    scenes: int,
    iteration: NDArray[np.float64],
    seconds: NDArray[np.float64],
    values: NDArray[np.float64],
    what: str,
) -> tuple[list[float], list[float], int]:
    """Seconds and values of a fit, mean over its scenes, and their number."""
    _, at, counts = np.unique(iteration, return_inverse=True, return_counts=True)
    x, y = (np.bincount(at, column) / counts for column in (seconds, values))
    # The bytes are of all scenes together, in every scene's row.
    divisor = _UNIT[what] * (scenes if what == "bytes_estimate" else 1)
    return (x / scenes).tolist(), (y / divisor).tolist(), scenes


def _mean(fits: list[tuple[list[float], list[float], int]]) -> tuple[list[float], list[float]]:
    """Mean of fits, each weighted by its scenes, at all times (or iterations) at which any was evaluated.

    It begins where all have been; a finished fit keeps its last value.
    """
    begin = max(x[0] for x, _, _ in fits)
    times = sorted({t for x, _, _ in fits for t in x if t >= begin and t > 0})
    weights = np.array([scenes for _, _, scenes in fits], dtype=float)
    values = np.array([np.interp(times, x, y) for x, y, _ in fits])
    return times, [float(v) for v in weights @ values / weights.sum()]


def time_to_quality(curve: Curve, level: float) -> float | None:
    """Seconds per scene at which a curve first reaches a level, linear between evaluations; None if never.

    A curve that begins above a level has reached it by its first evaluation.
    """
    for i, (x, y) in enumerate(zip(curve.x, curve.y, strict=True)):
        if y >= level:
            if i == 0:
                return x
            before, low = curve.x[i - 1], curve.y[i - 1]
            return before + (x - before) * (level - low) / (y - low)
    return None


class Part(NamedTuple):
    """A part of the loss over iterations, where it is above zero."""

    name: str
    x: list[float]
    y: list[float]


@dataclass(frozen=True)
class Losses:
    """The loss of a method on a dataset, mean over its fits.

    Attributes:
        dataset: with its preset where there are several.
        title: of the method.
        parts: over iterations; the whole first.
        marks: (iteration, text): where a stage begins; without stages the first evaluation with parts that
            the first one had not.
        small: names of parts too small to be drawn.
    """

    dataset: str
    title: str
    parts: list[Part]
    marks: list[tuple[float, str]]
    small: list[str]


def losses(rows: pd.DataFrame) -> list[Losses]:
    """The losses by part of all methods that tell them; figures that are no part of the sum are left out.

    With many variants only the defaults are shown (:func:`.reports.style.named`).

    Args:
        rows: as of :func:`steps`.
    """
    panels = []
    for dataset, every in comparable(rows):
        own = named(models(every))
        for names, fits in every.groupby(["method", "variant"], dropna=False, sort=False):
            if model(*names) not in own:
                continue
            table = _parts_table(fits)
            if len(table.columns) < 2:
                continue
            floor = LEAST_SHARE * float(table["loss"].max())
            large = [name for name in table.columns if float(table[name].max()) > floor]
            positive = ((str(name), table[name][table[name] > 0]) for name in large)
            parts = [Part(name, [*map(float, line.index)], [*map(float, line)]) for name, line in positive]
            small = [str(name) for name in table.columns if name not in large]
            panels.append(Losses(dataset, model(*names).title, parts, _marks(fits, parts), small))
    return panels


def steps(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The rows of `losses`, and as such those of `curve` of methods that it has none of.

    The former are means over stretches, the latter (of older fits) single steps.

    Args:
        tables: with `losses` and `curve` as documented.
    """
    import pandas as pd

    keys = ["dataset", "preset", "method", "variant"]
    stretches = at_default_rates(tables["losses"])
    curve = at_default_rates(tables["curve"])
    keys_of_stretches = {tuple(row) for row in stretches[keys].fillna("").itertuples(index=False)}
    single = [tuple(row) not in keys_of_stretches for row in curve[keys].fillna("").itertuples(index=False)]
    curve = curve[pd.Series(single, curve.index, dtype=bool)].dropna(subset=["loss", "loss_parts"])
    parts = [
        json.dumps({"loss": float(loss), **json.loads(parts)})
        for loss, parts in zip(curve["loss"], curve["loss_parts"], strict=True)
    ]
    return pd.concat([stretches, curve[["job", *keys, "iteration"]].assign(losses=parts)], ignore_index=True)


def _parts_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Iteration -> "loss" and its parts, mean over fits that were all evaluated then."""
    import pandas as pd

    fits = []
    texts = rows["losses"].tolist()
    last = rows["iteration"].to_numpy(float)
    first = rows["first"].to_numpy(float, na_value=np.nan) if "first" in rows else np.full(len(rows), np.nan)
    for fit in places(rows, ["job"]).values():
        _, once = np.unique(last[fit], return_index=True)
        fit = fit[np.sort(once)]
        fit = fit[_long_enough(last[fit] - first[fit] + 1)]
        steps = {int(last[at]): json.loads(texts[at]) for at in fit}
        # A part cannot exceed the sum; what does is another figure (bits per attribute, say).
        other = {
            name for step in steps.values() for name, value in step.items() if value > 1.001 * step["loss"]
        }
        fits.append({at: {n: v for n, v in step.items() if n not in other} for at, step in steps.items()})
    shared = sorted(set.intersection(*(set(fit) for fit in fits)))
    names = list(dict.fromkeys(name for fit in fits for at in shared for name in fit[at]))
    means = {name: [_present_mean([fit[at].get(name) for fit in fits]) for at in shared] for name in names}
    return pd.DataFrame(means, index=shared, dtype=float)


def _present_mean(values: list[float | None]) -> float:
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present else float("nan")


def _long_enough(steps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which stretches stages did not cut so short that they are single steps again; all if not known."""
    return np.isnan(steps).any() | (steps >= _SHORT * steps.max())  # type: ignore[no-any-return]


def _marks(rows: pd.DataFrame, parts: list[Part]) -> list[tuple[float, str]]:
    stretches = rows[rows["stage"].notna()] if "stage" in rows else rows[:0]
    if len(stretches):
        starts = stretches.groupby("stage", sort=False)["first"].min().sort_values()
        marks: list[tuple[float, str]] = []
        for stage, first in list(starts.items())[1:]:
            if marks and first - marks[-1][0] < _NEAR * stretches["iteration"].max():
                marks[-1] = marks[-1][0], f"{marks[-1][1]}, {stage}"
            else:
                marks.append((float(first), str(stage)))
        return marks
    begin = min(part.x[0] for part in parts)
    late: dict[float, list[str]] = {}
    for part in parts:
        if part.x[0] > begin:
            late.setdefault(part.x[0], []).append(part.name)
    return [(iteration, f"{', '.join(names)} first seen") for iteration, names in late.items()]
