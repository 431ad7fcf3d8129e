"""What the charts draw, taken from the documented tables; shared by the page and the figures.

Of training (convergence, anytime, losses) see :mod:`.reports.charts.training`, of rates
:mod:`.reports.curves`, of attributes :mod:`.reports.charts.features`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from econgs_bench.reports import floors
from econgs_bench.reports.charts import parts
from econgs_bench.reports.charts.parts import OTHER
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.fronts import pareto
from econgs_bench.reports.schema import COLUMNS
from econgs_bench.reports.style import OTHERS, Look, Model, label, looks, mean_key, mib, model, named, seconds
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.curves import Curve


AXIS = {
    name: COLUMNS[name]
    for name in ("size_bytes", "fps", "train_seconds", "peak_host_bytes", "peak_device_bytes")
}
"""Columns that PSNR is drawn against."""
_NEEDED = (
    "dataset", "preset", "split", "method", "base", "variant", "rate", "scene", "seed", "job", "status",
    "size_bytes", "psnr", "floor", "one_ray",
)  # fmt: skip
"""Columns of a trade-off but for its axis: groups of rows with all columns take five times as long."""
_FEW = 30  # points of a panel
_BAR = ["dataset", "method", "variant", "rate", "preset"]


class Spot(NamedTuple):
    """A scene, or the mean over all.

    Attributes:
        size: bytes, which order the means.
        keys: of the rows of the page's table that it stands for.
    """

    x: float
    y: float
    size: float
    name: str
    keys: list[str]


@dataclass
class Line:
    """A model without its rate knob.

    Attributes:
        model: whose.
        means: over scenes, at each rate, from the smallest model to the largest, whatever the axis.
        scenes: at all rates; none where means alone are shown.
    """

    model: Model
    means: list[Spot] = field(default_factory=list)
    scenes: list[Spot] = field(default_factory=list)


@dataclass
class Panel:
    """The chart of a dataset at one preset and split, which its title names where there are several.

    Attributes:
        title: dataset and protocol.
        lines: its models.
        better: 1 if a higher x is better, -1 if a lower one is.
        floor: of the truth, mean over the dataset's scenes; None where it is not known.
    """

    title: str
    lines: list[Line]
    better: int = -1
    floor: Floor | None = None

    @property
    def means(self) -> list[tuple[float, float]]:
        return [spot[:2] for line in self.lines for spot in line.means]

    @property
    def spots(self) -> list[tuple[float, float]]:
        """The means and the scenes."""
        return [spot[:2] for line in self.lines for spot in (*line.means, *line.scenes)]

    @property
    def front(self) -> list[tuple[float, float]]:
        """The means that no other mean is better than in both; empty where there is nothing to compare."""
        return pareto(self.means, self.better) if len(set(self.means)) > 1 else []

    def dominated(self, edge: float, bottom: float) -> list[tuple[float, float]]:
        """Outline of the region in which everything is worse than some mean.

        Args:
            edge: the worst x that the axis shows.
            bottom: the worst y that it shows.
        """
        corners = self.front
        if not corners:
            return []
        steps = [(corners[0][0], bottom)]
        for (x, y), (after, _) in zip(corners, [*corners[1:], (edge, 0.0)], strict=True):
            steps += [(x, y), (after, y)]
        return [*steps, (edge, bottom)]

    @property
    def to_avoid(self) -> list[tuple[float, float]]:
        """What labels keep clear of: the means, and the scenes where they are few."""
        return self.spots if len(self.spots) <= _FEW else self.means

    def looks(self, models: list[Model]) -> list[tuple[Line, Look]]:
        """The lines with their looks, gray ones first; what is on the Pareto front is never gray."""
        front = set(self.front)
        apart = [line.model for line in self.lines if any(spot[:2] in front for spot in line.means)]
        lines = {line.model: line for line in self.lines}
        styles = looks(lines, models, apart)
        return [(lines[each], style) for each, style in styles.items()]

    def labels(self, models: list[Model]) -> list[tuple[float, float, str, str]]:
        """(x, y, text, color): a line's title at its right end; at a scene if it has no mean of its own."""
        labels = []
        own = named(line.model for line in self.lines)
        for line, style in self.looks(models):
            if style is OTHERS:
                continue
            end = max(line.means or line.scenes, key=lambda spot: spot.x)
            # In the color of its method, which is named at another mark.
            text = line.model.title if line.model in own else line.model.options or line.model.title
            text += "" if line.means else " (incomplete)"
            labels.append((end.x, end.y, text, style.color))
        return labels


def tradeoff(results: pd.DataFrame, against: str) -> list[Panel]:
    """PSNR against a column of :data:`AXIS`, by dataset; rows not ok or without either number are left out.

    The mean over scenes is only drawn where all scenes of the dataset are there. Fits that differ only in a
    rate knob are one line. Of more variants than are named (:func:`.reports.style.named`) the others are
    without their scenes.

    Args:
        results: of the seeds that :func:`.reports.curves.with_shared_seeds` leaves.
        against: the column.
    """
    unit = AXIS[against].scale
    columns = list(dict.fromkeys((*_NEEDED, against)))
    panels = []
    for title, rows in comparable(results.loc[results["kind"] == "basic", columns]):
        good = rows[
            (rows["status"] == "ok") & rows["psnr"].notna() & rows[against].notna() & (rows[against] > 0)
        ]
        if good.empty:
            continue
        scenes = set(rows["scene"])
        lines: dict[Model, Line] = {}
        for keys, group in good.groupby(["method", "variant", "rate"], dropna=False, sort=False):
            family = model(keys[0], group["base"].iloc[0])
            line = lines.setdefault(family, Line(family))
            # By hand: pandas takes milliseconds per group, and a report has thousands.
            seeds: dict[str, list[tuple[float, float, str]]] = {}
            for scene, *seed in zip(
                *(group[name] for name in ("scene", against, "psnr", "job")), strict=True
            ):
                seeds.setdefault(str(scene), []).append((float(seed[0]), float(seed[1]), str(seed[2])))
            means = {scene: np.mean([(x, y) for x, y, _ in rows], axis=0) for scene, rows in seeds.items()}
            line.scenes += [
                Spot(float(x) / unit, float(y), 0.0, scene, [job for *_, job in seeds[scene]])
                for scene, (x, y) in means.items()
            ]
            if scenes == set(means):
                x, y = np.mean(list(means.values()), axis=0)
                size = float(group["size_bytes"].fillna(0).astype(float).mean())
                spot = Spot(float(x) / unit, float(y), size, "mean over scenes", [mean_key(group.iloc[0])])
                line.means.append(spot)
        own = named(lines)
        for line in lines.values():
            line.means.sort(key=lambda spot: (spot.size, spot.x))
            if line.means and line.model not in own:
                line.scenes.clear()
        panels.append(Panel(title, list(lines.values()), AXIS[against].better, floors.of_table(rows)))
    return panels


def rate_panels(curves: dict[str, list[Curve]]) -> dict[str, list[Curve]]:
    """What a chart shows of the datasets on which some method was measured at several rates.

    Those methods, and of the others the default settings (the first where there are none): single sizes of
    all variants are what the trade-off charts are for.
    """
    chart = {}
    for dataset, rows in curves.items():
        models = {curve.model for curve in rows if len(curve.points) > 1}
        if not models:
            continue
        methods = {each.method for each in models}
        for each in sorted((curve.model for curve in rows), key=lambda each: each.options != ""):
            if not each.options or each.method not in methods:
                models.add(each)
                methods.add(each.method)
        chart[dataset] = [curve for curve in rows if curve.model in models]
    return chart


@dataclass
class Bar:
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


def ledger(table: pd.DataFrame) -> tuple[list[Bar], list[str]]:
    """Bytes of all scenes and what they share, mean over seeds: the bars, and the families of parts."""
    bars = []
    for axes, rows in table.groupby(_BAR, dropna=False, sort=False):
        # One fit listed twice (under two runs) is one set of bytes.
        rows = _whole_seeds(rows).drop_duplicates(["job", "scene", "part"])
        seeds = max(1, rows["seed"].nunique())
        sums = {
            str(part): float(count) / seeds for part, count in rows.groupby("part")["bytes"].sum().items()
        }
        bar = Bar(str(axes[0]), _title(table, *axes), {}, f"{mib(sum(sums.values()))} MiB")
        for part, count in sums.items():
            family = parts.family(part)
            bar.amounts[family] = bar.amounts.get(family, 0.0) + count
            bar.details.setdefault(family, {})[part] = count
        bars.append(bar)
    for family in parts.small(bar.amounts for bar in bars) - {OTHER}:
        for bar in bars:
            if family in bar.amounts:
                bar.amounts[OTHER] = bar.amounts.get(OTHER, 0.0) + bar.amounts.pop(family)
                bar.details.setdefault(OTHER, {}).update(bar.details.pop(family))
    return _by_dataset(table, bars), parts.ordered(family for bar in bars for family in bar.amounts)


FRAME = "frame"


def timing(table: pd.DataFrame) -> tuple[list[Bar], list[str]]:
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
        bars.append(Bar(str(axes[0]), _title(table, *axes), amounts, seconds(whole)))
    return _by_dataset(table, bars), parts.ordered(part for bar in bars for part in bar.amounts)


def _whole_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Without seeds that lack scenes which others have."""
    scenes = rows.groupby("seed", dropna=False)["scene"].transform("nunique")
    whole: pd.DataFrame = rows[scenes == scenes.max()]
    return whole


def _by_dataset(table: pd.DataFrame, bars: list[Bar]) -> list[Bar]:
    """The bars of a dataset stand together."""
    order = {str(dataset): i for i, dataset in enumerate(table["dataset"].unique())}
    return sorted(bars, key=lambda bar: order[bar.dataset])


def _title(table: pd.DataFrame, *axes: Any) -> str:
    dataset, method, variant, rate, preset = axes
    words = [str(dataset), label(method, variant, rate)]
    words += [str(preset)] if table["preset"].nunique() > 1 else []
    return " · ".join(words)
