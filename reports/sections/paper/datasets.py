"""Datasets and the cost of rendering their volumes, beside the published values."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.sections.paper.layouts import reference_rows

if TYPE_CHECKING:
    import pandas as pd

PUBLISHED = "published"
_GIB = float(2**30)
_KEYS = ["dataset", "preset", "width", "height", "renderer", "backend", "machine", "threads"]
_COLUMNS = (
    "dataset", "resolution", "variables", "volume_gib", "scenes", "cpu_gib", "gpu_gib", "ms_per_view", "fps",
    "setup_seconds", "image", "renderer", "machine",
)  # fmt: skip


@cache
def published() -> dict[str, dict[str, str]]:
    """Name of a dataset -> the published row of the same dataset, or of the one that it imitates."""
    return {name: row for row in reference_rows("datasets") for name in row["names"].split(";")}


def costs(dvr: pd.DataFrame) -> pd.DataFrame:
    """One row per dataset, and the published row, if there is one, below it.

    Time per view and frame rate are means over the basic scenes; memory and set-up time are maxima. If a
    scene failed, these numbers are missing, and ``scenes`` is as "3 of 4".
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    basic = dvr[dvr["kind"] == "basic"]
    for dataset, runs in basic.groupby("dataset", sort=False):
        good = runs[runs["status"] == "ok"]
        for keys, group in good.groupby(_KEYS[1:], dropna=False, sort=False):
            row = dict(zip(_KEYS[1:], keys, strict=True))
            first = group.iloc[0]
            same = (runs["preset"] == row["preset"]) & (runs["width"] == row["width"])
            count, measured = runs.loc[same, "scene"].nunique(), group["scene"].nunique()
            variables = {name for names in group["variables"] for name in str(names).split(";")}
            volumes = group.drop_duplicates("variables")["volume_bytes"]
            row |= {
                "dataset": str(dataset),
                "resolution": _resolution(first["nx"], first["ny"], first["nz"]),
                "variables": len(variables),
                "volume_gib": float(volumes.sum()) / _GIB,
                "scenes": str(count) if measured == count else f"{measured} of {count}",
                "image": f"{first['width']} \N{MULTIPLICATION SIGN} {first['height']}",
                "renderer": f"{first['renderer']}, {first['backend']}",
            }
            if measured == count:
                row |= {name: float(group[name].mean()) for name in ("ms_per_view", "fps")}
                row["setup_seconds"] = float(group["setup_seconds"].max())
                row["cpu_gib"] = _largest(group["peak_host_bytes"])
                row["gpu_gib"] = _largest(group["peak_device_bytes"])
            rows.append(row)
        if good.empty:
            rows.append({"dataset": str(dataset), "scenes": f"0 of {runs['scene'].nunique()}"})
        if (reference := published().get(str(dataset).partition("@")[0])) is not None:
            rows.append(_published_row(reference))
    return pd.DataFrame(rows, columns=list(_COLUMNS)).astype(object)


def _largest(values: pd.Series) -> float | None:
    return float(values.max()) / _GIB if values.notna().any() else None


def _resolution(*dims: Any) -> str:
    return " \N{MULTIPLICATION SIGN} ".join(str(n) for n in dims)


def _published_row(row: dict[str, str]) -> dict[str, Any]:
    numbers = {name: float(row[name]) for name in ("volume_gib", "cpu_gib", "gpu_gib") if row[name]}
    return {
        "dataset": f"{row['published']} ({PUBLISHED})",
        "resolution": _resolution(row["nx"], row["ny"], row["nz"]),
        "variables": int(row["variables"]),
        "scenes": row["scenes"],
        **numbers,
    }
