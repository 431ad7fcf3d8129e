"""What models spend on a scene: bytes and primitives for a quality, the worth of a KiB, what could go."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports.curves import Curve, Need, at_default_rates, curves, need
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import PRUNED
from econgs_bench.reports.style import MISSING, Model, model
from econgs_bench.reports.tables.columns import places
from econgs_bench.reports.tables.protocols import ORIGIN

if TYPE_CHECKING:
    import pandas as pd

LEVELS = (30.0, 35.0, 40.0)
"""PSNR in dB for which bytes and primitives are reported."""
DROP = "prunable_010"
"""Of :data:`.reports.schema.PRUNED`, the one that the chart shows and the conclusion names."""
KIB = 1024.0
_LEAST_SCENES = 3
"""Scenes of a method for which growth is reported."""
_LEAST_DECADES = 1.0
"""Decades of volume size a method's scenes must span before growth is reported."""


@dataclass(frozen=True)
class Economy:
    """What a method (with options that are no rate knob) spends on a scene.

    Attributes:
        scene: as "fuel/jet", with preset and split where there are several.
        model: without the rate knob.
        volume: bytes of the scene's classified volume without loss; None where it has none.
        needs: level of :data:`LEVELS` -> what it takes; None where no model reaches it.
        gains: dB per added KiB between neighbours of the curve, from the smallest model on.
        gaussians: of the default's model; None where it was not asked what could go.
        prunable: column of :data:`.reports.schema.PRUNED` -> share of them that can go.
    """

    scene: str
    model: Model
    volume: float | None
    needs: dict[float, Need | None]
    gains: tuple[float, ...]
    gaussians: float | None
    prunable: dict[str, float]

    def ratio(self, level: float) -> float | None:
        """Bytes for a quality / those of the volume."""
        need = self.needs[level]
        return need.bytes / self.volume if need is not None and self.volume is not None else None

    def bytes_text(self, level: float) -> str:
        """As "12.3 (0.5 ×)": KiB, and how many times the bytes of the volume."""
        need, ratio = self.needs[level], self.ratio(level)
        if need is None:
            return MISSING
        times = "" if ratio is None else f" ({_times(ratio)} \N{MULTIPLICATION SIGN})"
        return f"{_bound(need)}{need.bytes / KIB:,.1f}{times}"

    def primitives_text(self, level: float) -> str:
        """As "1,234"."""
        need = self.needs[level]
        if need is None or math.isnan(need.primitives):
            return MISSING
        return f"{_bound(need)}{need.primitives:,.0f}"

    def gains_text(self) -> str:
        """As "0.12, 0.01"."""
        return ", ".join(f"{gain:.2g}" for gain in self.gains).replace("-", "\N{MINUS SIGN}") or MISSING

    def prunable_text(self, column: str) -> str:
        """As "12.3"."""
        return f"{100 * self.prunable[column]:.1f}" if column in self.prunable else MISSING


def _times(ratio: float) -> str:
    return f"{ratio:,.0f}" if ratio >= 100.0 else f"{ratio:.2g}"


def _bound(need: Need) -> str:
    return "\N{LESS-THAN OR EQUAL TO} " if need.bound else ""


@once
def of_report(report: Report) -> list[Economy]:
    """The economies of a report."""
    return economies(report.at_shared_seeds, report.table("complexity"))


def economies(results: pd.DataFrame, complexity: pd.DataFrame) -> list[Economy]:
    """One per scene and curve, in the tables' order.

    Args:
        results: of basic scenes, at the seeds that :func:`.reports.curves.with_shared_seeds`
            leaves.
        complexity: the table of that name; empty where no suite asked for it.
    """
    if results.empty:
        return []
    coded = complexity[complexity["lossless_bytes"].notna()]
    keys = zip(coded["dataset"], coded["scene"], strict=True)
    volumes = dict(zip(keys, coded["lossless_bytes"].astype(float), strict=True))
    datasets = results[ORIGIN] if ORIGIN in results else results["dataset"]
    apart = results.assign(dataset=results["dataset"] + "/" + results["scene"])
    sources = dict(zip(apart["dataset"], zip(datasets, results["scene"], strict=True), strict=True))
    pruned = _pruned(apart)
    found = []
    for scene, own in curves(apart).items():
        for curve in own:
            row = curve.points[0].row
            cell = (row["dataset"], row["preset"], row["split"], curve.model)
            gaussians, shares = pruned.get(cell, (None, {}))
            found.append(
                Economy(
                    scene=scene,
                    model=curve.model,
                    volume=volumes.get(sources[row["dataset"]]),
                    needs={level: need(curve, level) for level in LEVELS},
                    gains=gains(curve),
                    gaussians=gaussians,
                    prunable=shares,
                )
            )
    return found


def _pruned(results: pd.DataFrame) -> dict[tuple[str, str, str, Model], tuple[float, dict[str, float]]]:
    """Scene, preset, split and model -> its Gaussians and what of them can go, means over seeds."""
    if "gaussians" not in results:
        return {}
    rows = at_default_rates(results[results["gaussians"].notna()])
    keys = ["dataset", "preset", "split", "method", "base"]
    numbers = rows[["gaussians", *PRUNED]].to_numpy(float, na_value=np.nan)
    cells = {}
    for (scene, preset, split, method, base), at in places(rows, keys).items():
        count, *shares = numbers[at].mean(axis=0).tolist()
        cells[scene, preset, split, model(method, base)] = count, dict(zip(PRUNED, shares, strict=True))
    return cells


def gains(curve: Curve) -> tuple[float, ...]:
    """Worth of an added KiB in dB, between neighbouring points of different sizes."""
    return tuple(
        (large.psnr - small.psnr) / ((large.bytes - small.bytes) / KIB)
        for small, large in pairwise(curve.points)
        if large.bytes > small.bytes
    )


def has_facts(economies: Iterable[Economy]) -> bool:
    """Whether a suite asked for anything of these that is not a rate-distortion curve."""
    return any(one.volume is not None or one.gaussians is not None for one in economies)


def decisive(economies: Sequence[Economy]) -> float:
    """The level at which the most models are between two sizes; the higher of equals."""
    counts = {level: len(_inner(economies, level)) for level in LEVELS}
    return max(LEVELS, key=lambda level: (counts[level], level))


def _inner(economies: Iterable[Economy], level: float) -> list[Economy]:
    return [one for one in economies if (need := one.needs[level]) is not None and not need.bound]


def conclusion(economies: Sequence[Economy]) -> str:
    """Who needs the fewest bytes, how bytes grow with the volume's, and what could go, in sentences."""
    level = decisive(economies)
    return " ".join(filter(None, (_fewest(economies, level), _growth(economies, level), _spare(economies))))


def _fewest(economies: Sequence[Economy], level: float) -> str:
    """Where several methods reach the level."""
    winners: Counter[str] = Counter()
    for scene in dict.fromkeys(one.scene for one in economies):
        needs = {one.model.title: one.needs[level] for one in economies if one.scene == scene}
        sizes = {title: own.bytes for title, own in needs.items() if own is not None}
        if len(sizes) > 1:
            winners[min(sizes, key=sizes.__getitem__)] += 1
    if not winners:
        return ""
    names = ", ".join(f"{name} on {count}" for name, count in winners.most_common())
    return (
        f"Fewest bytes for {level:g} dB, of the sizes measured, on {winners.total()} scenes that several "
        f"methods reach it on: {names}."
    )


def growth(economies: Sequence[Economy], level: float) -> dict[Model, float]:
    """How many times the bytes a model takes where the volume takes ten times as many.

    By least squares of logarithms. Models on fewer than :data:`_LEAST_SCENES` scenes, or on volumes of fewer
    decades than :data:`_LEAST_DECADES`, have none; bounds do not count.
    """
    factors = {}
    for each in dict.fromkeys(one.model for one in economies):
        spots = [
            (math.log10(one.volume), math.log10(own.bytes))
            for one in _inner(economies, level)
            if one.model == each and one.volume and (own := one.needs[level]) is not None
        ]
        x, y = np.array(spots).T if spots else (np.zeros(0), np.zeros(0))
        if len(spots) >= _LEAST_SCENES and np.ptp(x) >= _LEAST_DECADES:
            factors[each] = 10.0 ** float(np.polyfit(x, y, 1)[0])
    return factors


def _growth(economies: Sequence[Economy], level: float) -> str:
    factors = {each.title: factor for each, factor in growth(economies, level).items()}
    if not factors:
        return ""
    names = ", ".join(f"{name} {factors[name]:.2g}" for name in sorted(factors, key=factors.__getitem__))
    return f"Where the volume takes ten times the bytes, models for {level:g} dB take so many times: {names}."


def _spare(economies: Sequence[Economy]) -> str:
    """On the scenes that all methods have, so that means compare."""
    shares: dict[str, dict[str, float]] = {}
    for one in economies:
        if DROP in one.prunable:
            shares.setdefault(one.model.title, {})[one.scene] = one.prunable[DROP]
    scenes = set.intersection(*map(set, shares.values())) if shares else set()
    if not scenes:
        return ""
    means = {name: float(np.mean([own[scene] for scene in scenes])) for name, own in shares.items()}
    ordered = sorted(means, key=means.__getitem__, reverse=True)
    names = ", ".join(f"{name} {100 * means[name]:.0f} %" for name in ordered)
    where = "one scene" if len(scenes) == 1 else f"mean over {len(scenes)} scenes"
    return f"Share of Gaussians that could go at {PRUNED[DROP]:g} dB, {where}: {names}."
