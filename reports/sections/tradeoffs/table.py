"""PSNR of each model against a cost, from the documented tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports import floors
from econgs_bench.reports.charts.tradeoff import Spot, Tradeoff, TradeoffLine
from econgs_bench.reports.schema import COLUMNS
from econgs_bench.reports.style import Model, mean_key, model, named
from econgs_bench.reports.tables.protocols import comparable, finished

if TYPE_CHECKING:
    import pandas as pd

AXES = {
    "size": ("size", "size_bytes"),
    "fps": ("speed", "fps"),
    "time": ("training time", "train_seconds"),
    "memory": ("host memory", "peak_host_bytes"),
    "device-memory": ("device memory", "peak_device_bytes"),
}
"""Name of an axis -> what it is called, and its column."""
_NEEDED = (
    "dataset", "preset", "split", "method", "base", "variant", "rate", "scene", "seed", "job", "status",
    "size_bytes", "psnr", "floor", "one_ray",
)  # fmt: skip
"""Columns of a trade-off but for its axis: groups of rows with all columns take five times as long."""


def tradeoffs(results: pd.DataFrame, against: str) -> list[Tradeoff]:
    """PSNR against a column, by dataset; rows not ok or without either number are left out.

    The mean over scenes is only drawn where all scenes of the dataset are there. Fits that differ only in a
    rate knob are one line. Of more variants than are named (:func:`.reports.style.named`) the others are
    without their scenes.

    Args:
        results: of the seeds that :func:`.reports.curves.with_shared_seeds` leaves.
        against: the column.
    """
    column = COLUMNS[against]
    columns = list(dict.fromkeys((*_NEEDED, against)))
    panels = []
    for title, rows in comparable(results.loc[results["kind"] == "basic", columns]):
        good = rows[finished(rows) & rows["psnr"].notna() & rows[against].notna() & (rows[against] > 0)]
        if good.empty:
            continue
        scenes = set(rows["scene"])
        lines: dict[Model, TradeoffLine] = {}
        for keys, group in good.groupby(["method", "variant", "rate"], dropna=False, sort=False):
            family = model(keys[0], group["base"].iloc[0])
            line = lines.setdefault(family, TradeoffLine(family))
            # By hand: pandas takes milliseconds per group, and a report has thousands.
            seeds: dict[str, list[tuple[float, float, str]]] = {}
            for scene, *seed in zip(
                *(group[name] for name in ("scene", against, "psnr", "job")), strict=True
            ):
                seeds.setdefault(str(scene), []).append((float(seed[0]), float(seed[1]), str(seed[2])))
            means = {scene: np.mean([(x, y) for x, y, _ in rows], axis=0) for scene, rows in seeds.items()}
            line.scenes += [
                Spot(float(x) / column.scale, float(y), scene, [job for *_, job in seeds[scene]])
                for scene, (x, y) in means.items()
            ]
            if scenes == set(means):
                x, y = np.mean(list(means.values()), axis=0)
                size = float(group["size_bytes"].fillna(0).astype(float).mean())
                key = [mean_key(group.iloc[0])]
                line.means.append(Spot(float(x) / column.scale, float(y), "mean over scenes", key, size))
        own = named(lines)
        for line in lines.values():
            line.means.sort(key=lambda spot: (spot.size, spot.x))
            if line.means and line.model not in own:
                line.scenes.clear()
        floor = floors.of_table(rows)
        panels.append(Tradeoff(title, column.axis_title, list(lines.values()), column.better, floor))
    return panels
