"""Where methods fail, and what they spend: few views, other seeds, hard views; scenes of known complexity."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports.charts.lines import Line
from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.style import MIB, label, model
from econgs_bench.reports.tables.columns import places
from econgs_bench.reports.tables.protocols import ORIGIN, conditions

if TYPE_CHECKING:
    import pandas as pd

COMPLEXITY = {
    "primitives": "primitives",
    "size_bytes": "size [MiB]",
    "psnr": "PSNR [dB]",
}
"""Columns drawn over what a scene holds, and the titles of their axes."""
LEAST_FAMILY = 3
"""So many datasets of one family are drawn as a curve."""
_NUMBERED = re.compile(r"([^@]*?)[_-]?(\d+)")  # a number after @ is of the grid


@dataclass(frozen=True)
class Record:
    """How a method fared on a dataset, all scenes, seeds and rates.

    Attributes:
        dataset, title: of whom.
        rows: results that were to be measured.
        failed: status -> how many of them.
        seed_gap: largest difference of PSNR between two seeds on the same scene, dB; None with one seed.
        view_gap: mean over scenes and seeds of the median view's PSNR less that of the worst, dB.
        lowest: PSNR of the worst view of all, dB.
        missing, excess: of the truth's alpha, in the scene and seed that are worst off; None if not measured.
    """

    dataset: str
    title: str
    rows: int
    failed: dict[str, int]
    seed_gap: float | None
    view_gap: float | None
    lowest: float | None
    missing: float | None
    excess: float | None


def records(results: pd.DataFrame, views: pd.DataFrame) -> list[Record]:
    """One record per dataset, method, variant, preset and split of single scenes, in the tables' order."""
    basic = results[results["kind"] == "basic"]
    rows_of_methods = []
    axes = ["dataset", "method", "variant", "preset", "split"]
    of_jobs = views.groupby("job")["psnr"].agg(["median", "min"])
    for keys, rows in basic.groupby(axes, dropna=False, sort=False):
        good = rows[rows["status"] == "ok"]
        failed = rows.loc[rows["status"] != "ok", "status"].value_counts()
        seen = of_jobs.reindex(good["job"]).dropna()
        rows_of_methods.append(
            Record(
                dataset=str(keys[0]),
                title=" ".join([label(keys[1], keys[2]), *conditions(rows.iloc[0], basic)]),
                rows=len(rows),
                failed={str(status): int(count) for status, count in failed.items()},
                seed_gap=_seed_gap(good),
                view_gap=float((seen["median"] - seen["min"]).mean()) if len(seen) else None,
                lowest=float(seen["min"].min()) if len(seen) else None,
                missing=_most(good, "missing"),
                excess=_most(good, "excess"),
            )
        )
    return rows_of_methods


def _seed_gap(good: pd.DataFrame) -> float | None:
    good = good[good["psnr"].notna()]
    seed, psnr = good["seed"].tolist(), good["psnr"].to_numpy(float)
    scenes = places(good, ["scene", "rate"]).values()
    gaps = [float(np.ptp(psnr[at])) for at in scenes if len({seed[i] for i in at}) > 1]
    return max(gaps, default=None)


def _most(good: pd.DataFrame, column: str) -> float | None:
    return float(good[column].max()) if column in good and good[column].notna().any() else None


def few_views(results: pd.DataFrame) -> dict[str, list[Line]]:
    """Dataset -> mean PSNR over scenes and seeds at each number of training views, a line per method.

    Datasets with one number are left out, and so is what not all scenes and seeds have reached, and scenes
    that were not fitted with every number of views.

    Args:
        results: as :func:`.reports.tables.protocols.by_training_views` makes it.
    """
    if results.empty or ORIGIN not in results:
        return {}
    basic = results[(results["kind"] == "basic") & (results["dataset"] != results[ORIGIN])]
    panels: dict[str, list[Line]] = {}
    for dataset, rows in basic.groupby(ORIGIN, sort=False):
        scenes = [set(part["scene"]) for _, part in rows.groupby("requested_views")]
        rows = rows[rows["scene"].isin(set.intersection(*scenes))]
        if lines := _lines(rows, rows["requested_views"], "psnr"):
            panels[str(dataset)] = lines
    return panels


def by_complexity(results: pd.DataFrame, what: str) -> dict[str, list[Line]]:
    """Family of datasets -> a column of :data:`COMPLEXITY` over the number in their names, a line per method.

    A family are datasets whose names differ in their last number alone, as blobs_1, blobs_8, blobs_64: what
    that number counts is what the scene holds. Values are means over scenes and seeds; incomplete sets are
    left out, and so are other rates of a method that has its default.
    """
    if results.empty or what not in results:
        return {}
    basic = at_default_rates(results[results["kind"] == "basic"])
    usual = basic["rate"].isna()
    basic = basic[usual | ~basic["method"].isin(basic.loc[usual, "method"])]
    panels: dict[str, list[Line]] = {}
    for family, members in families(basic["dataset"].unique()).items():
        rows = basic[basic["dataset"].isin(members)]
        if lines := _lines(rows, rows["dataset"].map(members), what):
            panels[family] = lines
    return panels


def families(datasets: Iterable[str]) -> dict[str, dict[str, int]]:
    """Stem -> dataset -> number, of those with at least :data:`LEAST_FAMILY` members."""
    stems: dict[str, dict[str, int]] = {}
    for dataset in datasets:
        match = _NUMBERED.fullmatch(str(dataset))
        if match and int(match[2]) > 0:
            stems.setdefault(match[1], {})[str(dataset)] = int(match[2])
    return {stem: members for stem, members in stems.items() if len(members) >= LEAST_FAMILY}


def _lines(rows: pd.DataFrame, numbers: pd.Series, what: str) -> list[Line]:
    """Mean of a column at each number, a line per method; of several presets and splits, each on its own.

    Numbers at which a method lacks any value, or zero bytes or primitives, have no point.
    """
    unit = MIB if what == "size_bytes" else 1.0
    lines = []
    axes = ["method", "variant", "rate", "preset", "split"]
    for keys, fits in rows.groupby(axes, dropna=False, sort=False):
        values = fits[what].astype("Float64").where(fits["status"] == "ok")
        means = values.groupby(numbers).agg(lambda part: part.mean(skipna=False)).dropna()
        means = means if what == "psnr" else means[means > 0]
        if len(means):
            title = " ".join([label(*keys[:3]), *conditions(fits.iloc[0], rows)])
            x, y = [float(v) for v in means.index], [float(v) / unit for v in means]
            lines.append(Line(model(*keys[:2]), title, x, y))
    return lines
