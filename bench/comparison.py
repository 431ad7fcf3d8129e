"""Two runs of the same experiments, compared view by view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reports.schema import METRICS
from reports.tables.protocols import by_scene_choice

if TYPE_CHECKING:
    import pandas as pd

EXPERIMENT = ("dataset", "scene", "method", "variant", "rate", "preset", "split", "seed")


def compared(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Compare two tables ``views``.

    Args:
        first: views of the first run.
        second: views of the second run.

    Returns:
        One row per experiment and metric: both means, mean difference (second - first) and its extremes, and
        ``views``, the number of common views on which both have the metric. Empty if the runs have no view in
        common. The attribute "views" of the frame counts all common views.
    """
    import pandas as pd

    keys = [*EXPERIMENT, "view"]
    text = {key: "string" for key in keys if key not in ("rate", "seed")}
    left, right = (
        table[[*keys, *METRICS]].astype(text).assign(rate=table["rate"].fillna(-1.0))
        for table in map(by_scene_choice, (first, second))
    )
    pairs = left.merge(right, on=keys, suffixes=("_1", "_2"))
    rows = []
    for experiment, group in pairs.groupby(list(EXPERIMENT), dropna=False):
        for metric in METRICS:
            values = group[[f"{metric}_1", f"{metric}_2"]].dropna()
            if values.empty:
                continue
            one, two = (values[column] for column in values)
            difference = two - one
            rows.append(
                {
                    **dict(zip(EXPERIMENT, experiment, strict=True)),
                    "metric": metric,
                    "views": len(values),
                    "first": one.mean(),
                    "second": two.mean(),
                    "difference": difference.mean(),
                    "least": difference.min(),
                    "greatest": difference.max(),
                }
            )
    table = pd.DataFrame(rows)
    if len(table):
        table["rate"] = table["rate"].where(table["rate"] != -1.0)
    table.attrs["views"] = len(pairs)
    return table
