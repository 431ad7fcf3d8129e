"""What the charts draw, taken from the documented tables; shared by the page and the figures.

Of training (convergence, anytime, losses) see :mod:`reports.training`, of rates
:mod:`reports.rate_distortion`, of attributes :mod:`reports.features`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from reports.rate_distortion import split_rate
from reports.style import MIB, label, mib, row_key, seconds

if TYPE_CHECKING:
    import pandas as pd


class AxisSpec(NamedTuple):
    """An axis: its title, what its column is divided by, the unit's short name, and 1 if more is better."""

    title: str
    unit: float
    short: str
    better: int


AXIS = {
    "size_bytes": AxisSpec("size per scene [MiB]", MIB, "MiB", -1),
    "fps": AxisSpec("frames per second", 1.0, "FPS", 1),
    "train_seconds": AxisSpec("training time per scene [s]", 1.0, "s", -1),
    "peak_host_bytes": AxisSpec("peak host memory [MiB]", MIB, "MiB", -1),
    "peak_device_bytes": AxisSpec("peak device memory [MiB]", MIB, "MiB", -1),
}


MOST_LABELS = 24


@dataclass
class Line:
    """A method, its mean over scenes at each rate, and the scenes themselves.

    Attributes:
        name: series that decides the color.
        title: what it is called.
        x, y: the means, from the smallest model to the largest; ``size`` in bytes.
        keys: of the table's rows that they are in; ``scene_keys`` of the scenes'.
    """

    name: str
    title: str
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)
    size: list[float] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    scene_x: list[float] = field(default_factory=list)
    scene_y: list[float] = field(default_factory=list)
    scenes: list[str] = field(default_factory=list)
    scene_keys: list[str] = field(default_factory=list)


@dataclass
class Panel:
    """One dataset's chart."""

    dataset: str
    lines: list[Line]
    better: int = -1

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

    def labels(self) -> list[tuple[float, float, str, str]]:
        """(x, y, text, series): a line's title at its right end; at a scene if it has no mean of its own.

        None if there are more than :data:`MOST_LABELS`: they would not find room.
        """
        spots: list[tuple[float, float, str, str]] = []
        if len(self.lines) > MOST_LABELS:
            return spots
        for line in self.lines:
            xs, ys = (line.x, line.y) if line.x else (line.scene_x, line.scene_y)
            end = max(range(len(xs)), key=xs.__getitem__)
            text = line.title if line.x else f"{line.title} (incomplete)"
            spots.append((xs[end], ys[end], text, line.name))
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
    rate knob are one line.
    """
    if results.empty or against not in results:
        return []
    basic = results[results["kind"] == "basic"]
    panels = []
    for dataset, rows in basic.groupby("dataset", sort=False):
        good = rows[
            (rows["status"] == "ok") & rows["psnr"].notna() & rows[against].notna() & (rows[against] > 0)
        ]
        if good.empty:
            continue
        lines: dict[tuple, Line] = {}
        for keys, group in good.groupby(
            ["method", "variant", "rate", "preset", "split"], dropna=False, sort=False
        ):
            name = label(keys[0], keys[1])
            told = [str(keys[i]) for i, axis in ((3, "preset"), (4, "split")) if rows[axis].nunique() > 1]
            family = label(keys[0], split_rate(keys[1])[0])
            line = lines.setdefault((family, *keys[3:]), Line(name, " ".join([family, *told])))
            unit = AXIS[against].unit
            same = (rows["preset"] == keys[3]) & (rows["split"] == keys[4])
            wanted = set(rows.loc[same, "scene"])
            per_scene = group.groupby("scene", sort=False)[[against, "psnr"]].mean()
            line.scene_x += [float(v) / unit for v in per_scene[against]]
            line.scene_y += [float(v) for v in per_scene["psnr"]]
            line.scenes += [str(scene) for scene in per_scene.index]
            line.scene_keys += [row_key(dataset, scene, *keys[:3]) for scene in per_scene.index]
            if wanted == set(per_scene.index):
                line.x.append(float(per_scene[against].mean()) / unit)
                line.y.append(float(per_scene["psnr"].mean()))
                line.keys.append(row_key(dataset, "", *keys[:3]))
                line.size.append(float(group["size_bytes"].fillna(0).astype(float).mean()))
        for line in lines.values():
            _sort(line)
        panels.append(Panel(str(dataset), list(lines.values()), AXIS[against].better))
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
        amounts: part -> bytes or seconds.
        told: what the whole is.
    """

    dataset: str
    title: str
    amounts: dict[str, float]
    told: str = ""

    @property
    def total(self) -> float:
        return sum(self.amounts.values())

    def percent(self, part: str) -> float:
        return 100.0 * self.amounts.get(part, 0.0) / self.total if self.total else 0.0


def ledger(table: pd.DataFrame) -> tuple[list[Bar], list[str]]:
    """Bytes of all scenes and what they share: the bars, and the parts in order of their total size."""
    if table.empty:
        return [], []
    bars = []
    keys = ["dataset", "method", "variant", "rate", "preset", "seed"]
    for axes, rows in table.groupby(keys, dropna=False, sort=False):
        # One fit listed twice (under two runs) is one set of bytes.
        rows = rows.drop_duplicates(["job", "scene", "part"])
        sums = {str(part): float(count) for part, count in rows.groupby("part")["bytes"].sum().items()}
        bars.append(Bar(str(axes[0]), _title(table, *axes), sums, f"{mib(sum(sums.values()))} MiB"))
    return _by_dataset(table, bars), _parts(bars)


FRAME, OTHER = "frame", "other"
_STAGES = ("decode", "shade", "rasterise")


def timing(table: pd.DataFrame) -> tuple[list[Bar], list[str]]:
    """Seconds of a frame by part, mean over scenes: the bars, and the parts in the order they happen.

    Parts are timed one by one: what of the frame they do not explain is :data:`OTHER`.
    """
    if table.empty:
        return [], []
    bars = []
    keys = ["dataset", "method", "variant", "rate", "preset", "seed"]
    for axes, rows in table.groupby(keys, dropna=False, sort=False):
        rows = rows.drop_duplicates(["job", "part"])
        means = {str(part): float(value) for part, value in rows.groupby("part")["seconds"].mean().items()}
        frame = means.pop(FRAME, 0.0)
        parts = {part: value for part, value in means.items() if value > 0}
        if not parts:
            continue
        parts[OTHER] = max(0.0, frame - sum(parts.values()))
        whole = frame or sum(parts.values())
        bars.append(Bar(str(axes[0]), _title(table, *axes), parts, seconds(whole)))
    order = {part: i for i, part in enumerate((*_STAGES, "", OTHER))}
    return _by_dataset(table, bars), sorted(_parts(bars), key=lambda part: order.get(part, len(_STAGES)))


def _by_dataset(table: pd.DataFrame, bars: list[Bar]) -> list[Bar]:
    """The bars of a dataset stand together."""
    order = {str(dataset): i for i, dataset in enumerate(table["dataset"].unique())}
    return sorted(bars, key=lambda bar: order[bar.dataset])


def _parts(bars: list[Bar]) -> list[str]:
    totals: dict[str, float] = {}
    for bar in bars:
        for part, amount in bar.amounts.items():
            totals[part] = totals.get(part, 0.0) + amount
    return sorted(totals, key=lambda part: -totals[part])


def _title(table: pd.DataFrame, *axes: Any) -> str:
    dataset, method, variant, rate, preset, seed = axes
    words = [str(dataset), label(method, variant, rate)]
    words += [str(preset)] if table["preset"].nunique() > 1 else []
    words += [f"seed {seed}"] if table["seed"].nunique() > 1 else []
    return " · ".join(words)
