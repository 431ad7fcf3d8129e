"""Which method is best under transfer functions that nobody trained on, by their distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.volumes.conclusion import VOLUMES
from econgs_bench.reports.style import MISSING, Model, model, signed
from econgs_bench.reports.tables.protocols import comparable, of_shared_seeds

if TYPE_CHECKING:
    import pandas as pd

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


@dataclass(frozen=True)
class Target:
    """The mean over seeds of a model under one transfer function: over those that all models have there.

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
        results: with the columns of :data:`.reports.schema.TABLES`; failed rows are left out.
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
    shown = of_shared_seeds(shown, ("dataset", "preset", "split", "scene", "distance"))
    keys = ["dataset", "preset", "split", "scene", "distance", "method", "variant", "rate"]
    means = shown.groupby(keys, sort=False, dropna=False)["psnr"].mean().reset_index()
    return [
        Target(
            panel,
            str(row["scene"]),
            model(row["method"], row["variant"]),
            float(row["distance"]),
            float(row["psnr"]),
        )
        for panel, rows in comparable(means)
        for row in records(rows[rows["rate"].isna()])
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


def conclusion(found: list[Target]) -> str:
    """Which model has the highest mean on trained and on unseen transfer functions, in sentences.

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
            sentences.append(
                f"{panel}, highest mean PSNR by distance of the transfer function: {'; '.join(parts)}."
            )
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
            several = "trained" in own and len(values) > 1
            loss = signed(values[0] - values[-1], sign=False) if several else MISSING
            lines.append([panel, each.title, *cells, loss])
    return lines
