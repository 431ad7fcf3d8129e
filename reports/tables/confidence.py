"""How sure means over scenes are: intervals over views, spread over seeds, differences of methods."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports.schema import METRICS
from reports.statistics import Interval, Sample, Views
from reports.style import MISSING, absent, label
from reports.tables.means import summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

FEW_SEEDS = 5
"""So many single values are told besides their standard deviation."""
_AXES = ["dataset", "preset", "split"]


def intervals(results: pd.DataFrame, views: pd.DataFrame, metrics: Sequence[str] = METRICS) -> pd.DataFrame:
    """One row per dataset, method and quality metric (of ``metrics``): how sure its mean over scenes is.

    Columns: dataset, method (with variant and rate), preset, split, metric, mean, low, high (95 % over views,
    of the mean over seeds), views (that were drawn from), seeds, seed_std (over the seeds' means),
    seed_values (these means, where there are several but few: "34.00; 34.30").
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for row, samples in _measured(results, views, metrics):
        for metric, sample in samples.items():
            found = sample.interval()
            if found is None:
                continue
            seeds = _seeds(results, row, metric)
            several = len(seeds) > 1
            rows.append(
                _who(row)
                | {"metric": metric, **_of(found), "seeds": len(seeds)}
                | {"seed_std": float(pd.Series(seeds).std()) if several else None}
                | {"seed_values": "; ".join(f"{v:.4f}" for v in seeds) if 1 < len(seeds) <= FEW_SEEDS else ""}
            )
    columns = ["dataset", "method", "preset", "split", "metric", "mean", "low", "high", "views", "seeds"]
    return pd.DataFrame(rows, columns=[*columns, "seed_std", "seed_values"])


def comparisons(results: pd.DataFrame, views: pd.DataFrame, metrics: Sequence[str] = METRICS) -> pd.DataFrame:
    """One row per pair of methods and quality metric (of ``metrics``): first - second on the same views.

    Columns: dataset, preset, split, metric, first, second, difference, low, high (95 %), views, apart (the
    interval excludes zero). The intervals are of single comparisons, not of all together.
    """
    import pandas as pd

    rows = []
    measured = _measured(results, views, metrics)
    for i, (first, of_first) in enumerate(measured):
        for second, of_second in measured[i + 1 :]:
            if any(first[axis] != second[axis] for axis in _AXES):
                continue
            for metric in of_first.keys() & of_second.keys():
                found = of_first[metric].minus(of_second[metric])
                if found is None:
                    continue
                numbers = _of(found)
                numbers["difference"] = numbers.pop("mean")
                names = {"first": _who(first)["method"], "second": _who(second)["method"]}
                axes = {axis: str(first[axis]) for axis in _AXES}
                rows.append(axes | {"metric": metric} | names | numbers | {"apart": found.excludes_zero})
    columns = [*_AXES, "metric", "first", "second", "difference", "low", "high", "views", "apart"]
    table = pd.DataFrame(rows, columns=columns)
    order = {metric: i for i, metric in enumerate(METRICS)}
    return table.sort_values("metric", key=lambda names: names.map(order), kind="stable").reset_index(
        drop=True
    )


def ends(low: float | None, high: float | None, sign: bool = False) -> str:
    """An interval as "-0.56 to -0.003": as many digits as tell its ends from zero, where it excludes zero."""
    if absent(low) or absent(high):
        return MISSING
    low, high = float(low or 0.0), float(high or 0.0)
    apart = low > 0 or high < 0
    enough = (n for n in range(2, 6) if not apart or (round(low, n) and round(high, n)))
    digits = next(enough, 6)
    return f"{signed(low, digits, sign)} to {signed(high, digits, sign)}"


def signed(value: float, digits: int = 2, sign: bool = True) -> str:
    """A number with a minus sign that is none of a hyphen's length; never "-0.00"."""
    rounded = round(value, digits) + 0.0
    text = f"{rounded:+.{digits}f}" if sign else f"{rounded:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _measured(
    results: pd.DataFrame, views: pd.DataFrame, metrics: Sequence[str]
) -> list[tuple[Any, dict[str, Sample]]]:
    """The rows of the summary that are complete and have views, with their samples by metric."""
    if results.empty or views.empty:
        return []
    known = Views(views)
    made = []
    for _, row in summary(results).iterrows():
        samples = {metric: known.sample(row["jobs"], metric) for metric in metrics} if row["complete"] else {}
        present = {metric: sample for metric, sample in samples.items() if sample is not None}
        if present:
            made.append((row, present))
    return made


def _who(row: Any) -> dict[str, Any]:
    name = label(row["method"], row["variant"], row["rate"])
    return {"dataset": str(row["dataset"]), "method": name, "preset": row["preset"], "split": row["split"]}


def _of(found: Interval) -> dict[str, Any]:
    return {"mean": found.mean, "low": found.low, "high": found.high, "views": found.views}


def _seeds(results: pd.DataFrame, row: Any, metric: str) -> list[float]:
    """The mean over scenes of each seed."""
    jobs = results[results["job"].isin(row["jobs"])]
    return [float(part[metric].astype(float).mean()) for _, part in jobs.groupby("seed", sort=True)]
