"""The parts of the training loss over iterations.

Of fits that differ only in a rate knob the default's are shown: others are points of rate-distortion curves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.style import model, models, named
from econgs_bench.reports.tables.columns import places
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

LEAST_SHARE = 1e-5
"""Parts that never reach this share of the loss are not drawn."""
_SHORT = 0.25
"""Stretches shorter than this, against a fit's longest, are left out."""
_NEAR = 0.02
"""Stages that begin nearer to each other than this share of a fit share a mark."""


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
