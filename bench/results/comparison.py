"""Two runs of the same experiments, compared view by view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.reports.comparability import pair_differences
from econgs_bench.reports.schema import METRICS
from econgs_bench.reports.style import absent, label
from econgs_bench.reports.tables.protocols import by_scene_choice

if TYPE_CHECKING:
    import pandas as pd

EXPERIMENT = (
    "dataset", "scene", "method", "variant", "rate", "preset", "split", "requested_views", "seed",
)  # fmt: skip
_IDENTITY = ("truth", "renderer", "metric_versions")


def compared(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Compare two tables ``views``.

    Args:
        first: views of the first run.
        second: views of the second run.

    Returns:
        One row per experiment and metric: both means, mean difference (second - first) and its extremes, and
        ``views``, the number of common views on which both have the metric. Empty if the runs have no view in
        common. The attribute "views" of the frame counts all common views, "differences" has a line for each
        experiment or metric that both have and that is not compared (:mod:`.reports.comparability`).
    """
    import pandas as pd

    keys = [*EXPERIMENT, "view"]
    facts = [*keys, *METRICS, *_IDENTITY]
    text = {key: "string" for key in keys if key not in ("rate", "requested_views", "seed")}
    left, right = (
        table[facts].astype(text).assign(rate=table["rate"].fillna(-1.0))
        for table in map(by_scene_choice, (first, second))
    )
    pairs = left.merge(right, on=keys, suffixes=("_1", "_2"), validate="one_to_one")
    rows, differences, count = [], [], 0
    for experiment, group in pairs.groupby(list(EXPERIMENT), dropna=False):
        one, other = ({name: group[f"{name}_{side}"].iloc[0] for name in _IDENTITY} for side in (1, 2))
        who = dict(zip(EXPERIMENT, experiment, strict=True))
        title = f"{who['dataset']}/{who['scene']} {label(who['method'], who['variant'])}"
        apart = pair_differences(one, other)
        if absent(one["truth"]) or absent(other["truth"]):
            apart["truth"] = "what they were measured on is not known of both"
        differences += [f"{title}: {name}: {why}" for name, why in apart.items()]
        if "truth" in apart:
            continue
        count += len(group)
        for metric in METRICS:
            values = group[[f"{metric}_1", f"{metric}_2"]].dropna()
            if values.empty or metric in apart:
                continue
            before, after = (values[column] for column in values)
            difference = after - before
            rows.append(
                {
                    **who,
                    "metric": metric,
                    "views": len(values),
                    "first": before.mean(),
                    "second": after.mean(),
                    "difference": difference.mean(),
                    "least": difference.min(),
                    "greatest": difference.max(),
                }
            )
    table = pd.DataFrame(rows)
    if len(table):
        table["rate"] = table["rate"].where(table["rate"] != -1.0)
    table.attrs |= {"views": count, "differences": list(dict.fromkeys(differences))}
    return table
