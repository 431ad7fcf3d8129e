"""What the charts draw, taken from the documented tables; shared by the page and the figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from reports.style import MIB, absent, label

if TYPE_CHECKING:
    import pandas as pd


class AxisSpec(NamedTuple):
    """An axis: its title, and what its column is divided by."""

    title: str
    unit: float


AXIS = {
    "size_bytes": AxisSpec("size per scene [MiB]", MIB),
    "fps": AxisSpec("frames per second", 1.0),
    "train_seconds": AxisSpec("training time per scene [s]", 1.0),
}
CURVE_AXIS = {"train_seconds": "training time of the fit [s]", "iteration": "iteration"}


@dataclass
class Line:
    """A method with variant: its mean over scenes at each rate, and the scenes themselves."""

    name: str
    title: str
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)
    scene_x: list[float] = field(default_factory=list)
    scene_y: list[float] = field(default_factory=list)
    scenes: list[str] = field(default_factory=list)


@dataclass
class Panel:
    """One dataset's chart."""

    dataset: str
    lines: list[Line]

    @property
    def all_x(self) -> list[float]:
        return [x for line in self.lines for x in (*line.x, *line.scene_x)]

    @property
    def all_y(self) -> list[float]:
        return [y for line in self.lines for y in (*line.y, *line.scene_y)]

    def labels(self) -> list[tuple[float, float, str, str]]:
        """(x, y, text, series): a line's title at its right end; at a scene if it has no mean of its own."""
        spots = []
        for line in self.lines:
            xs, ys = (line.x, line.y) if line.x else (line.scene_x, line.scene_y)
            end = max(range(len(xs)), key=lambda i: xs[i])
            text = line.title if line.x else f"{line.title} (incomplete)"
            spots.append((xs[end], ys[end], text, line.name))
        return spots


def tradeoff(results: pd.DataFrame, against: str) -> list[Panel]:
    """PSNR against a column, by dataset; rows that are not ok or lack either number are left out.

    The mean over scenes is only drawn where all scenes of the dataset are there.
    """
    if results.empty:
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
            line = lines.setdefault((name, *keys[3:]), Line(name, " ".join([name, *told])))
            unit = AXIS[against].unit
            same = (rows["preset"] == keys[3]) & (rows["split"] == keys[4])
            wanted = set(rows.loc[same, "scene"])
            per_scene = group.groupby("scene", sort=False)[[against, "psnr"]].mean()
            line.scene_x += [float(v) / unit for v in per_scene[against]]
            line.scene_y += [float(v) for v in per_scene["psnr"]]
            line.scenes += [str(scene) for scene in per_scene.index]
            if wanted == set(per_scene.index):
                line.x.append(float(per_scene[against].mean()) / unit)
                line.y.append(float(per_scene["psnr"].mean()))
        for line in lines.values():
            order = sorted(range(len(line.x)), key=lambda i, line=line: line.x[i])  # type: ignore[misc]
            line.x, line.y = [line.x[i] for i in order], [line.y[i] for i in order]
        panels.append(Panel(str(dataset), list(lines.values())))
    return panels


@dataclass
class Curve:
    """Validation PSNR of one fit's scene."""

    name: str
    scene: str
    title: str
    x: list[float]
    y: list[float]


def convergence(curve: pd.DataFrame, against: str) -> dict[str, list[Curve]]:
    """Dataset -> curves; titled by what tells them apart (method, scene, seed)."""
    panels: dict[str, list[Curve]] = {}
    if curve.empty:
        return panels
    known = curve[curve["psnr_val"].notna() & curve[against].notna()]
    for dataset, rows in known.groupby("dataset", sort=False):
        methods = len({label(m, v) for m, v in zip(rows["method"], rows["variant"], strict=True)})
        many = {axis: rows[axis].nunique() > 1 for axis in ("scene", "seed", "preset")}
        lines = []
        keys = ["job", "method", "variant", "scene", "preset", "seed"]
        for (_, method, variant, scene, preset, seed), group in rows.groupby(keys, dropna=False, sort=False):
            group = group.sort_values("iteration")
            name = label(method, variant)
            words = [name] if methods > 1 else []
            words += [str(scene)] if many["scene"] or not words else []
            words += [str(preset)] if many["preset"] and not absent(preset) else []
            words += [f"seed {seed}"] if many["seed"] else []
            x, y = ([float(v) for v in group[column]] for column in (against, "psnr_val"))
            lines.append(Curve(name, str(scene), " · ".join(words), x, y))
        panels[str(dataset)] = lines
    return panels


@dataclass
class Bar:
    """Bytes by part of one method on one dataset (all its scenes and what they share)."""

    title: str
    bytes: dict[str, int]

    @property
    def total(self) -> int:
        return sum(self.bytes.values())

    def percent(self, part: str) -> float:
        """Share of a part; models differ in size by orders, so bars of bytes would hide the small ones."""
        return 100.0 * self.bytes.get(part, 0) / max(1, self.total)


def ledger(table: pd.DataFrame) -> tuple[list[Bar], list[str]]:
    """The bars, and the parts in order of their total size."""
    if table.empty:
        return [], []
    bars = []
    keys = ["dataset", "method", "variant", "rate", "preset", "seed"]
    for (dataset, method, variant, rate, preset, seed), rows in table.groupby(keys, dropna=False, sort=False):
        words = [str(dataset), label(method, variant, rate)]
        words += [str(preset)] if table["preset"].nunique() > 1 else []
        words += [f"seed {seed}"] if table["seed"].nunique() > 1 else []
        # One fit listed twice (under two runs) is one set of bytes.
        rows = rows.drop_duplicates(["job", "scene", "part"])
        sums = rows.groupby("part")["bytes"].sum()
        bars.append(Bar(" · ".join(words), {str(part): int(count) for part, count in sums.items()}))
    totals: dict[str, int] = {}
    for bar in bars:
        for part, count in bar.bytes.items():
            totals[part] = totals.get(part, 0) + count
    return bars, sorted(totals, key=lambda part: -totals[part])
