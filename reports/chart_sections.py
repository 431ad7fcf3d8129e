"""The sections of the page that hold charts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from reports import plots
from reports.style import color, series

if TYPE_CHECKING:
    import pandas as pd

_TRADEOFFS = (
    ("PSNR and size", "size_bytes"),
    ("PSNR and speed", "fps"),
    ("PSNR and training time", "train_seconds"),
)


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: id of its heading.
        title: text of its heading, not escaped.
        html: what stands under the heading.
    """

    anchor: str
    title: str
    html: str


def chart_sections(tables: dict[str, pd.DataFrame]) -> list[Section]:
    """The sections for which there are data, in the order of the page.

    Args:
        tables: results, views, curve, ledger, timing and features as documented in docs/architecture.md.
    """
    made = (_convergence(tables), _tradeoffs(tables["results"]), _ledger(tables["ledger"]))
    return [section for section in made if section is not None]


def _convergence(tables: dict[str, pd.DataFrame]) -> Section | None:
    results, curve = tables["results"], tables["curve"]
    order = series(results, curve)
    pairs = [plots.convergence(curve, against, order) for against in ("train_seconds", "iteration")]
    if not any(pairs):
        return None
    told = "PSNR on a few validation views while training; the clock stands still meanwhile."
    if (results["split"] == "test").any():
        told += (
            " With split “test” these views are trained on too: the curves then show how the fit "
            "proceeds, not how good new views are."
        )
    parts = [f"<p>{told}</p>{_legend(series(curve), order)}"]
    for dataset in dict.fromkeys([*pairs[0], *pairs[1]]):
        drawn = [_chart(figures[dataset], "") for figures in pairs if dataset in figures]
        parts.append(f'<h3>{escape(dataset)}</h3><div class="charts">{"".join(drawn)}</div>')
    return Section("convergence", "Convergence", "\n".join(parts))


def _tradeoffs(results: pd.DataFrame) -> Section | None:
    drawn = {against: plots.tradeoffs(results, against) for _, against in _TRADEOFFS}
    datasets = list(dict.fromkeys(name for figures in drawn.values() for name in figures))
    if not datasets:
        return None
    parts = [
        "<p>Large marks: mean over the dataset's scenes; small marks: single scenes. Horizontal axes are "
        "logarithmic.</p>"
    ]
    for dataset in datasets:
        cards = [_chart(drawn[a][dataset], caption) for caption, a in _TRADEOFFS if dataset in drawn[a]]
        parts.append(f'<h3>{escape(dataset)}</h3><div class="charts">{"".join(cards)}</div>')
    return Section("tradeoffs", "Trade-offs", "\n".join(parts))


def _ledger(table: pd.DataFrame) -> Section | None:
    figure = plots.ledger(table)
    if figure is None:
        return None
    words = "Bytes of the files that a model is loaded from, by part, over all scenes of a dataset."
    return Section("ledger", "Size ledger", f"<p>{words}</p>{_chart(figure, '')}")


def _chart(figure: plots.Figure, caption: str) -> str:
    """A chart: the element that the page's script draws it into, and after it its JSON."""
    text = json.dumps(figure, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    head = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    height = figure["layout"]["height"]
    return (
        f'<figure class="card">{head}<div data-figure style="height:{height}px"></div>'
        f'<script type="application/json">{text}</script></figure>'
    )


def _legend(shown: list[str], names: list[str]) -> str:
    """Which color is which method, where charts have too many lines to name each."""
    if len(shown) < 2:
        return ""
    entries = " &nbsp; ".join(
        f'<span class="dot" style="background:{color(name, names)}"></span>{escape(name)}' for name in shown
    )
    return f'<p class="note">{entries}</p>'
