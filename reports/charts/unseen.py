"""How models do under transfer functions that nobody trained on: PSNR over distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reports.charts.chart import Axis, Chart, Panel, Series, linear_axis
from reports.charts.elements import Section, cards, legend, table
from reports.charts.volumes import VOLUMES
from reports.style import MISSING, Model, legend_entries, looks, model
from reports.tables.columns import records

if TYPE_CHECKING:
    import pandas as pd

    from reports.charts.report import Report

BANDS = (
    (0.0, "trained"),
    (1 / 3, "up to \N{VULGAR FRACTION ONE THIRD}"),
    (2 / 3, "up to \N{VULGAR FRACTION TWO THIRDS}"),
    (1.0, "beyond"),
)
"""Highest distance of a band, and its name."""
HEADS = ("Dataset", "Method", *(name for _, name in BANDS), "Loss to the farthest")
"""Of :func:`rows`."""
_CLEAR = 0.1
"""Lead in dB from which a method is named alone."""
_WORDS = (
    "Transfer functions between and beyond those that were trained on: their bumps are moved by shares of "
    "their widths, narrowed and widened, and scenes are blended. Distance is 0 where the transfer function "
    "is one of the training, at any opacity, and 1 where no value is visible in both. A method whose models "
    "hold their colors and opacities cannot follow a bump: it is given the trained scenes that come "
    "nearest, at opacities (and palettes, where it edits them) fitted to the transfer function."
)


@dataclass(frozen=True)
class Target:
    """The mean over seeds of a model under one transfer function.

    Attributes:
        panel: dataset with its protocol.
        name: scene and edit.
        distance: from the trained transfer function, in [0, 1].
        psnr: in dB.
    """

    panel: str
    name: str
    model: Model
    distance: float
    psnr: float

    @property
    def band(self) -> str:
        """Name of the band of :data:`BANDS`."""
        return next(name for highest, name in BANDS if self.distance <= highest + 1e-9)


def targets(results: pd.DataFrame) -> list[Target]:
    """Trained and unseen transfer functions of the datasets on which bumps were moved.

    Args:
        results: with the columns of :data:`reports.schema.TABLES`; failed rows are left out.
    """
    if "distance" not in results:
        return []
    edit = results["edit"].fillna("")
    moved = edit.str.contains("shift=|width=", regex=True)
    shown = results[results["dataset"].isin(set(results.loc[moved, "dataset"])) & results["psnr"].notna()]
    distance = shown["distance"].where(shown["edit"].fillna("") != "", 0.0)
    shown = shown.assign(distance=distance)[
        distance.notna() & ((distance > 0) | (shown["edit"].fillna("") == ""))
    ]
    keys = ["dataset", "preset", "split", "scene", "distance", "method", "variant", "rate"]
    means = shown.groupby(keys, sort=False, dropna=False)["psnr"].mean().reset_index()
    several = [axis for axis in ("preset", "split") if means[axis].nunique() > 1]
    return [
        Target(
            " \N{MIDDLE DOT} ".join([str(row["dataset"]), *(str(row[axis]) for axis in several)]),
            str(row["scene"]),
            model(row["method"], row["variant"]),
            float(row["distance"]),
            float(row["psnr"]),
        )
        for row in records(means[means["rate"].isna()])
    ]


def band_means(found: list[Target], panel: str) -> dict[Model, dict[str, tuple[float, float]]]:
    """Model -> band -> mean distance and mean PSNR, over the transfer functions that all models have."""
    own = [one for one in found if one.panel == panel]
    by_model: dict[Model, dict[str, Target]] = {}
    for one in own:
        by_model.setdefault(one.model, {})[one.name] = one
    shared = set.intersection(*(set(names) for names in by_model.values()))
    means: dict[Model, dict[str, tuple[float, float]]] = {}
    for each, named in by_model.items():
        for _, band in BANDS:
            spots = [
                (one.distance, one.psnr) for name, one in named.items() if name in shared and one.band == band
            ]
            if spots:
                distance, psnr = np.mean(spots, axis=0)
                means.setdefault(each, {})[band] = float(distance), float(psnr)
    return means


def unseen_chart(found: list[Target], models: list[Model]) -> Chart:
    """PSNR over distance, a panel per dataset: a mark per transfer function, a line through bands' means."""
    panels = []
    for panel in dict.fromkeys(one.panel for one in found):
        own = [one for one in found if one.panel == panel]
        means = band_means(found, panel)
        styles = looks({one.model: one.model for one in own}, models)
        series = []
        for each, look in styles.items():
            spots = [one for one in own if one.model == each]
            x, y = [one.distance for one in spots], [one.psnr for one in spots]
            names = [one.name for one in spots]
            series.append(Series(each.title, x, y, look, mark=4.5, opacity=0.45, names=names))
            if len(line := list(means.get(each, {}).values())) > 1:
                across, up = zip(*line, strict=True)
                series.append(Series(each.title, across, up, look._replace(dash="solid"), line=1.8, mark=8.0))
        ticks = tuple((value, f"{value:g}") for value in (0.0, 0.25, 0.5, 0.75, 1.0))
        x_axis = Axis("distance from the trained transfer function", -0.04, 1.04, ticks=ticks)
        y_axis = linear_axis([one.psnr for one in own], "PSNR [dB]", least=2.0)
        panels.append(Panel(panel, x_axis, y_axis, series))
    return Chart(panels, legend_entries([[one.model for one in found]], models))


def conclusion(found: list[Target]) -> str:
    """Which model is best on trained and on unseen transfer functions, in sentences.

    A method alone shows nothing. The compressed volume takes every transfer function: it stands apart.
    """
    sentences = []
    for panel in dict.fromkeys(one.panel for one in found):
        means = band_means(found, panel)
        parts = []
        for _, band in BANDS:
            scores = {
                each.title: own[band][1]
                for each, own in means.items()
                if band in own and each.method not in VOLUMES
            }
            if len(scores) < 2:
                continue
            first, second = sorted(scores, key=scores.__getitem__, reverse=True)[:2]
            where = (
                "on trained ones" if band == "trained" else f"{band} of the way" if "up" in band else "beyond"
            )
            if scores[first] - scores[second] < _CLEAR:
                parts.append(f"{where} {first} and {second} ({scores[first]:.1f} dB)")
            else:
                parts.append(f"{where} {first} ({scores[first]:.1f} dB, {second} {scores[second]:.1f})")
        if parts:
            sentences.append(f"{panel}, best model by distance of the transfer function: {'; '.join(parts)}.")
        for each, own in means.items():
            if each.method in VOLUMES and len(own) > 1:
                near, *_, far = (psnr for _, psnr in own.values())
                sentences.append(f"The {each.title} itself has {near:.1f} and, farthest, {far:.1f} dB.")
    return " ".join(sentences)


def rows(found: list[Target]) -> list[list[str]]:
    """Mean PSNR of each dataset and model by band, under :data:`HEADS`."""
    lines = []
    for panel in dict.fromkeys(one.panel for one in found):
        for each, own in band_means(found, panel).items():
            cells = [f"{own[band][1]:.2f}" if band in own else MISSING for _, band in BANDS]
            values = [own[band][1] for _, band in BANDS if band in own]
            loss = f"{values[0] - values[-1]:.2f}" if "trained" in own and len(values) > 1 else MISSING
            lines.append([panel, each.title, *cells, loss])
    return lines


def unseen_section(report: Report) -> Section | None:
    """The section of the page; None where no bump was moved."""
    found = targets(report.results)
    if not any(one.distance > 0.0 for one in found):
        return None
    chart = unseen_chart(found, report.models)
    note = "Mean PSNR [dB] over the transfer functions that all methods have, at their default rates."
    html = (
        f"<p><b>{conclusion(found)}</b></p><p>{_WORDS}</p>{legend(chart.legend)}{cards(chart.panels)}"
        f'{table("PSNR by distance of the transfer function", HEADS, rows(found))}<p class="note">{note}</p>'
    )
    return Section("unseen", "Unseen transfer functions", html, {"unseen-psnr": chart})
