"""What it costs to render the volumes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.reports.schema import by_name
from econgs_bench.reports.sections.paper.datasets import costs
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.tables.columns import cell
from econgs_bench.reports.tables.table import Table, to_html

if TYPE_CHECKING:
    import pandas as pd

_WORDS = (
    "A representation replaces direct volume rendering. These are its costs, one view at a time on the "
    "test path: times are means over the basic scenes, memory is the maximum of the whole process that "
    "renders. Published values follow the same dataset, or the one that imitates it; their renderer and "
    "machine differ."
)
_OF_SCENES = (
    "dataset", "scene", "kind", "ms_per_view", "ms_p05", "ms_p95", "fps", "setup_seconds", "peak_host_bytes",
    "peak_device_bytes", "status", "reason",
)  # fmt: skip


def section(page: Page) -> Section | None:
    """A table by dataset with the published values, and one by scene; None where no volume was rendered."""
    dvr = page.report.stored["dvr"]
    if dvr.empty:
        return None
    means = costs(dvr)
    names = [name for name in means.columns if name != "gpu_gib" or means[name].notna().any()]
    scenes = [name for name in _OF_SCENES if name != "peak_device_bytes" or dvr[name].notna().any()]
    if (dvr["status"] == "ok").all():
        scenes = scenes[:-2]
    more = to_html(_table("Cost of rendering each scene", dvr, scenes))
    return Section(
        "datasets",
        "Rendering the volumes",
        words=_WORDS,
        tables=[_table("Cost of rendering each volume", means, names)],
        files={f"datasets.{ending}": name for ending, name in _ENDINGS.items()},
        html=f"<details><summary>{len(dvr)} scenes</summary>{more}</details>",
    )


_ENDINGS = {"csv": "CSV", "md": "Markdown", "tex": "LaTeX"}


def _table(caption: str, rows: pd.DataFrame, names: list[str]) -> Table:
    columns = [by_name(name) for name in names]
    cells = [[cell(name, row[name]) for name in names] for _, row in rows.iterrows()]
    return Table(caption, [one.header for one in columns], cells, [one.numeric for one in columns])
