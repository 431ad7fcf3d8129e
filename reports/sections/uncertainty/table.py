"""Uncertainty of means over scenes: intervals over views and seeds, spread of seeds, differences."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import METRICS, records
from econgs_bench.reports.style import row_label

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.statistics import Interval, Views

FEW_SEEDS = 5
"""Up to this number of seeds, `intervals` lists the value of each seed."""
_AXES = ("dataset", "preset", "split")


@once
def intervals_of(report: Report) -> pd.DataFrame:
    """The intervals of a report."""
    return intervals(report.results, report.means, report.views)


@once
def comparisons_of(report: Report) -> pd.DataFrame:
    """The comparisons of a report."""
    return comparisons(report.means, report.views)


def intervals(results: pd.DataFrame, means: pd.DataFrame, views: Views) -> pd.DataFrame:
    """One row per dataset, method and metric: uncertainty of the mean over scenes.

    Columns: dataset, method (with variant and rate), preset, split, metric, mean, low, high (95 % over views
    and seeds), views (their number), seeds (their number), seed_std (over the seeds' means),
    seed_values (the seeds' means, if there are 2 to :data:`FEW_SEEDS`: "34.00; 34.30").

    Args:
        results: the table `results`.
        means: their :func:`~.reports.tables.means.summary`.
        views: the table `views`.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    by_job = results.set_index("job")
    for row in records(means[means["complete"]]):
        fits = by_job.loc[list(row["jobs"]), ["seed", *METRICS]].astype(float)
        of_seeds = fits.groupby("seed").mean()
        for metric in METRICS:
            sample = views.sample(row["jobs"], metric)
            interval = sample.interval() if sample is not None else None
            if interval is None:
                continue
            values = of_seeds[metric]
            few = 1 < len(values) <= FEW_SEEDS
            rows.append(
                _axes(row)
                | {"metric": metric, **interval._asdict(), "seeds": len(values)}
                | {"seed_std": float(values.std()) if len(values) > 1 else None}
                | {"seed_values": "; ".join(f"{value:.4f}" for value in values) if few else ""}
            )
    columns = ["dataset", "method", "preset", "split", "metric", "mean", "low", "high", "views", "seeds"]
    return pd.DataFrame(rows, columns=[*columns, "seed_std", "seed_values"])


def comparisons(means: pd.DataFrame, views: Views) -> pd.DataFrame:
    """One row per pair of methods and metric: first - second on the same views.

    Columns: dataset, preset, split, metric, first, second, difference, low, high (95 %), views, seeds (the
    fewer of the two models'), apart (the
    interval excludes zero). Each interval is for one comparison, not for all of them together.
    Arguments as of :func:`intervals`.
    """
    import pandas as pd

    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in records(means[means["complete"]]):
        groups.setdefault(tuple(str(row[axis]) for axis in _AXES), []).append(row)
    rows = []
    for metric in METRICS:
        for key, methods in groups.items():
            axes = dict(zip(_AXES, key, strict=True)) | {"metric": metric}
            for i, first in enumerate(methods):
                for second in methods[i + 1 :]:
                    interval = views.difference(first["jobs"], second["jobs"], metric)
                    if interval is not None:
                        rows.append(axes | _pair(first, second, interval))
    columns = [*_AXES, "metric", "first", "second", "difference", "low", "high", "views", "seeds", "apart"]
    return pd.DataFrame(rows, columns=columns)


def _axes(row: dict[str, Any]) -> dict[str, Any]:
    return {axis: str(row[axis]) for axis in _AXES} | {"method": row_label(row)}


def _pair(first: dict[str, Any], second: dict[str, Any], interval: Interval) -> dict[str, Any]:
    return {
        "first": row_label(first),
        "second": row_label(second),
        "difference": interval.mean,
        "low": interval.low,
        "high": interval.high,
        "views": interval.views,
        "seeds": interval.seeds,
        "apart": interval.excludes_zero,
    }
