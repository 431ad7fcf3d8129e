"""What the charts draw, taken from the documented tables; shared by the page and the figures.

Of training (convergence, anytime, losses) see :mod:`reports.charts.training`, of rates
:mod:`reports.charts.rate_distortion`, of attributes :mod:`reports.charts.features`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from reports.charts import parts
from reports.charts.parts import OTHER
from reports.charts.rate_distortion import with_shared_seeds
from reports.schema import COLUMNS
from reports.style import OTHERS, Look, label, look, mean_key, mib, named, options_of, seconds
from reports.tables.protocols import comparable
from reports.tables.results import distinct_processors

if TYPE_CHECKING:
    import pandas as pd


AXIS = {
    name: COLUMNS[name]
    for name in ("size_bytes", "fps", "train_seconds", "peak_host_bytes", "peak_device_bytes")
}
"""Columns that PSNR is drawn against."""

_CLOCK = {"fps": "processor", "train_seconds": "fit_processor"}
"""Column that was timed -> the one that tells on what."""
_NEEDED = (
    "dataset", "preset", "split", "method", "base", "variant", "rate", "scene", "seed", "job", "status",
    "size_bytes", "psnr",
)  # fmt: skip
"""Columns of a trade-off but for its axis: groups of rows with all columns take five times as long."""
_FEW = 30  # points of a panel
_BAR = ["dataset", "method", "variant", "rate", "preset"]


@dataclass
class Line:
    """A method, its mean over scenes at each rate, and the scenes themselves.

    Attributes:
        name: series that decides the color.
        title: what it is called.
        x, y: the means, from the smallest model to the largest; ``size`` in bytes.
        keys: of each mean, the keys of the table's rows that it stands for; ``scene_keys`` of the scenes'.
    """

    name: str
    title: str
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)
    size: list[float] = field(default_factory=list)
    keys: list[list[str]] = field(default_factory=list)
    scene_x: list[float] = field(default_factory=list)
    scene_y: list[float] = field(default_factory=list)
    scenes: list[str] = field(default_factory=list)
    scene_keys: list[list[str]] = field(default_factory=list)

    def without_scenes(self) -> None:
        """Leave the means alone: a chart of thirty variants with all their scenes is a cloud."""
        self.scene_x, self.scene_y, self.scenes, self.scene_keys = [], [], [], []


@dataclass
class Panel:
    """The chart of a dataset at one preset and split, which its title names where there are several.

    Attributes:
        mixed: the numbers were timed on several processors.
    """

    title: str
    lines: list[Line]
    better: int = -1
    mixed: bool = False

    def axis(self, title: str) -> str:
        """Title of the horizontal axis, which tells of times that do not compare."""
        return f"{title}, several processors" if self.mixed else title

    @property
    def means(self) -> list[tuple[float, float]]:
        return [spot for line in self.lines for spot in zip(line.x, line.y, strict=True)]

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
    def all_x(self) -> list[float]:
        return [x for line in self.lines for x in (*line.x, *line.scene_x)]

    @property
    def all_y(self) -> list[float]:
        return [y for line in self.lines for y in (*line.y, *line.scene_y)]

    @property
    def to_avoid(self) -> list[tuple[float, float]]:
        """What labels keep clear of: the means, and the scenes where they are few."""
        every = list(zip(self.all_x, self.all_y, strict=True))
        return every if len(every) <= _FEW else self.means

    def looks(self, names: list[str]) -> list[tuple[Line, Look]]:
        """The lines with their looks, gray ones first; what is on the Pareto front is never gray."""
        titles = named(line.title for line in self.lines)
        front = set(self.front)
        colored = [
            line.title in titles or not front.isdisjoint(zip(line.x, line.y, strict=True))
            for line in self.lines
        ]
        pairs = [
            (line, look(line.name, names) if own else OTHERS)
            for line, own in zip(self.lines, colored, strict=True)
        ]
        return sorted(pairs, key=lambda pair: pair[1] is not OTHERS)

    def labels(self, names: list[str]) -> list[tuple[float, float, str, str]]:
        """(x, y, text, color): a line's title at its right end; at a scene if it has no mean of its own."""
        spots: list[tuple[float, float, str, str]] = []
        titles = named(line.title for line in self.lines)
        for line, style in self.looks(names):
            if style is OTHERS:
                continue
            xs, ys = (line.x, line.y) if line.x else (line.scene_x, line.scene_y)
            end = max(range(len(xs)), key=xs.__getitem__)
            # In the color of its method, which is named at another mark.
            text = line.title if line.title in titles else options_of(line.title) or line.title
            text += "" if line.x else " (incomplete)"
            spots.append((xs[end], ys[end], text, style.color))
        return spots


def pareto(points: Iterable[tuple[float, float]], better: int) -> list[tuple[float, float]]:
    """The points that none dominates, from the best x to the worst (and so from the worst y to the best).

    Args:
        points: (x, y); more y is better.
        better: 1 if more x is better, -1 if less is.
    """
    front: list[tuple[float, float]] = []
    for x, y in sorted(set(points), key=lambda point: (-better * point[0], -point[1])):
        if not front or y > front[-1][1]:
            front.append((x, y))
    return front


def tradeoff(results: pd.DataFrame, against: str) -> list[Panel]:
    """PSNR against a column of :data:`AXIS`, by dataset; rows not ok or without either number are left out.

    The mean over scenes is only drawn where all scenes of the dataset are there. Fits that differ only in a
    rate knob are one line, of the seeds that all of them have. Of more variants than are named
    (:func:`reports.style.named`) the others are without their scenes.
    """
    if results.empty or against not in results:
        return []
    unit = AXIS[against].scale
    columns = list(dict.fromkeys((*_NEEDED, against, *_CLOCK.values())))
    panels = []
    for title, rows in comparable(with_shared_seeds(results.loc[results["kind"] == "basic", columns])):
        good = rows[
            (rows["status"] == "ok") & rows["psnr"].notna() & rows[against].notna() & (rows[against] > 0)
        ]
        if good.empty:
            continue
        scenes = set(rows["scene"])
        lines: dict[str, Line] = {}
        for keys, group in good.groupby(["method", "variant", "rate"], dropna=False, sort=False):
            family = label(keys[0], group["base"].iloc[0])
            line = lines.setdefault(family, Line(label(keys[0], keys[1]), family))
            per_scene = group.groupby("scene", sort=False)
            means = per_scene[[against, "psnr"]].mean()
            line.scene_x += [float(v) / unit for v in means[against]]
            line.scene_y += [float(v) for v in means["psnr"]]
            line.scenes += [str(scene) for scene in means.index]
            line.scene_keys += [[str(job) for job in seeds["job"]] for _, seeds in per_scene]
            if scenes == set(means.index):
                line.x.append(float(means[against].mean()) / unit)
                line.y.append(float(means["psnr"].mean()))
                line.keys.append([mean_key(group.iloc[0])])
                line.size.append(float(group["size_bytes"].fillna(0).astype(float).mean()))
        titles = named(line.title for line in lines.values())
        for line in lines.values():
            _sort(line)
            if line.x and line.title not in titles:
                line.without_scenes()
        mixed = against in _CLOCK and len(distinct_processors(good, _CLOCK[against])) > 1
        panels.append(Panel(title, list(lines.values()), AXIS[against].better, mixed))
    return panels


def _sort(line: Line) -> None:
    """The means from the smallest model to the largest: along the curve, whatever the axis."""
    order = sorted(range(len(line.x)), key=lambda i: (line.size[i], line.x[i]))
    line.x, line.y, line.size = ([values[i] for i in order] for values in (line.x, line.y, line.size))
    line.keys = [line.keys[i] for i in order]


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
    if table.empty:
        return [], []
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
    for family in parts.merged(bar.amounts for bar in bars) - {OTHER}:
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
    if table.empty:
        return [], []
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
