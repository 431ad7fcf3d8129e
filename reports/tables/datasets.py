"""Datasets and what rendering their volumes costs, in the layout of the published tables and beside them."""

from __future__ import annotations

import csv
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reports.schema import by_name
from reports.style import absent
from reports.tables.columns import cell

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
    """Name in this project -> the published row of that dataset, or of the one that it stands in for."""
    path = Path(__file__).parents[1] / "paper" / "published" / "datasets.csv"
    with path.open(encoding="utf-8", newline="") as file:
        return {name: row for row in csv.DictReader(file) for name in row["names"].split(";")}


def costs(dvr: pd.DataFrame) -> pd.DataFrame:
    """One row per dataset, and under it the published one where there is one.

    Time per view and frame rate are means over the basic scenes, memory and set-up time are the largest.
    Where a scene has failed those are missing, and ``scenes`` says so ("3 of 4").
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    basic = dvr[dvr["kind"] == "basic"]
    for dataset, every in basic.groupby("dataset", sort=False):
        good = every[every["status"] == "ok"]
        for keys, group in good.groupby(_KEYS[1:], dropna=False, sort=False):
            row = dict(zip(_KEYS[1:], keys, strict=True))
            first = group.iloc[0]
            same = (every["preset"] == row["preset"]) & (every["width"] == row["width"])
            wanted, have = every.loc[same, "scene"].nunique(), group["scene"].nunique()
            variables = {name for names in group["variables"] for name in str(names).split(";")}
            volumes = group.drop_duplicates("variables")["volume_bytes"]
            row |= {
                "dataset": str(dataset),
                "resolution": _resolution(first["nx"], first["ny"], first["nz"]),
                "variables": len(variables),
                "volume_gib": float(volumes.sum()) / _GIB,
                "scenes": str(have) if have == wanted else f"{have} of {wanted}",
                "image": f"{first['width']} \N{MULTIPLICATION SIGN} {first['height']}",
                "renderer": f"{first['renderer']}, {first['backend']}",
            }
            if have == wanted:
                row |= {name: float(group[name].mean()) for name in ("ms_per_view", "fps")}
                row["setup_seconds"] = float(group["setup_seconds"].max())
                row["cpu_gib"] = _largest(group["peak_host_bytes"])
                row["gpu_gib"] = _largest(group["peak_device_bytes"])
            rows.append(row)
        if good.empty:
            rows.append({"dataset": str(dataset), "scenes": f"0 of {every['scene'].nunique()}"})
        if (known := published().get(str(dataset).partition("@")[0])) is not None:
            rows.append(_published_row(known))
    return pd.DataFrame(rows, columns=list(_COLUMNS)).astype(object)


def _largest(values: pd.Series) -> float | None:
    known = values.dropna()
    return float(known.max()) / _GIB if len(known) else None


def _resolution(*dims: Any) -> str:
    return " \N{MULTIPLICATION SIGN} ".join(str(n) for n in dims)


def _published_row(said: dict[str, str]) -> dict[str, Any]:
    numbers = {k: float(said[k]) for k in ("volume_gib", "cpu_gib", "gpu_gib") if said[k]}
    return {
        "dataset": f"{said['published']} ({PUBLISHED})",
        "resolution": _resolution(said["nx"], said["ny"], said["nz"]),
        "variables": int(said["variables"]),
        "scenes": said["scenes"],
        **numbers,
    }


def section(dvr: pd.DataFrame) -> str:
    """The page's part about them."""
    table = costs(dvr)
    if table["gpu_gib"].isna().all():
        table = table.drop(columns="gpu_gib")
    lines = []
    for _, row in table.iterrows():
        of_paper = str(row["dataset"]).endswith(f"({PUBLISHED})")
        lines.append(f'<tr class="{"soft" if of_paper else "mean"}">{_cells(row, list(table.columns))}</tr>')
    return (
        "<p>Direct volume rendering, one view at a time on the test path: what a representation replaces. "
        "Times are means over the basic scenes, memory is the largest of any; the process that renders is "
        "counted whole. Published figures stand below the dataset that they are of, or that stands in for "
        "it, and are of another renderer and machine.</p>"
        f"{_table('What rendering each volume costs', list(table.columns), ''.join(lines))}"
        f"{_scenes(dvr)}"
        '<p class="note">Files: <a href="datasets.csv">CSV</a>, <a href="datasets.md">Markdown</a>, '
        '<a href="datasets.tex">LaTeX</a>.</p>'
    )


def _scenes(dvr: pd.DataFrame) -> str:
    names = ["dataset", "scene", "kind", "ms_per_view", "ms_p05", "ms_p95", "fps", "setup_seconds"]
    names += ["peak_host_bytes", "peak_device_bytes", "status", "reason"]
    names = [n for n in names if n != "peak_device_bytes" or dvr[n].notna().any()]
    if (dvr["status"] == "ok").all():
        names = names[:-2]
    lines = "".join(f"<tr>{_cells(row, names)}</tr>" for _, row in dvr.iterrows())
    table = _table("What rendering each scene costs", names, lines)
    return f"<details><summary>{len(dvr)} scenes</summary>{table}</details>"


def _cells(row: pd.Series, names: list[str]) -> str:
    first, *others = names
    cells = "".join(f'<td class="{_align(n)}">{escape(cell(n, row[n]))}</td>' for n in others)
    return f'<th scope="row">{escape(cell(first, row[first]))}</th>{cells}'


def _table(caption: str, names: list[str], lines: str) -> str:
    head = "".join(f'<th scope="col" class="{_align(n)}">{escape(by_name(n).header)}</th>' for n in names)
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{caption}"><table>'
        f"<caption>{caption}</caption><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>"
    )


def _align(name: str) -> str:
    texts = ("dataset", "scene", "kind", "resolution", "image", "renderer", "machine", "status", "reason")
    return "" if name in texts or absent(name) else "r"
