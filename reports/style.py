"""One look for all charts: colors that the color-blind can tell apart, names and units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pandas as pd

# Okabe & Ito (2008) without its yellow, which is too pale on white; then indigo and wine of P. Tol's "muted".
PALETTE = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F", "#000000",
    "#332288", "#882255",
)  # fmt: skip
DARK = {
    "#000000": "#ffffff", "#0072B2": "#4ba3dc", "#D55E00": "#f2803a",
    "#332288": "#9d90e8", "#882255": "#d8578f",
}  # fmt: skip
"""What would drown on dark -> what stands there instead."""
MARKERS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "star", "x", "cross")
DASHES = ("solid", "dash", "dot", "dashdot")
MOST_NAMED = 10
"""Models of a panel; of more, only each method's default has its color and name."""
MIB = float(2**20)
MISSING = "\N{EN DASH}"
TITLES = {
    "3dgs": "3DGS", "econgs": "ECoNGS", "scaffold-gs": "Scaffold-GS", "hac": "HAC", "ivr-gs": "iVR-GS",
    "vq-3dgs": "VQ-3DGS", "plenoxels": "Plenoxels", "ccnerf": "CCNeRF", "veg": "VEG",
    "mesh": "Triangle mesh", "sz3": "SZ3 volume", "zfp": "zfp volume", "3dgs-mcmc": "3DGS-MCMC",
    "hac-plus": "HAC++", "3dgs-coded": "3DGS, coded",
}  # fmt: skip
RATES: dict[str, dict[float, str]] = {
    "3dgs-coded": {
        1: "ply-zstd", 2: "spz-8bit-sh", 3: "spz", 4: "sog",
        5: "integer-half", 6: "integer", 7: "integer-double", 8: "integer-fourfold",
    },
}  # fmt: skip
"""Names of the rates of a method whose knob is a choice: the codecs of methods/coded/spec.py."""


def absent(value: Any) -> bool:
    """Whether a cell of a table is missing (None, NaN or pandas' NA)."""
    import pandas as pd

    return value is None or value is pd.NA or (isinstance(value, float) and math.isnan(value))


def counted(number: int, noun: str) -> str:
    """As "1 scene" or "2 scenes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def enumeration(names: Sequence[str]) -> str:
    """As "a, b and c", of at least one name."""
    *head, last = names
    return f"{', '.join(head)} and {last}" if head else last


def label(method: Any, variant: Any = "", rate: Any = None) -> str:
    """What a row is called in tables and charts."""
    parts = [TITLES.get(str(method), str(method))]
    if not absent(variant) and variant:
        parts.append(f"[{variant}]")
    if not absent(rate):
        parts.append(f"@ {RATES.get(str(method), {}).get(rate, f'{rate:g}')}")
    return " ".join(parts)


def row_label(row: Any) -> str:
    """What the model of a row is called."""
    return label(row["method"], row["variant"], row["rate"])


def mean_key(row: Any) -> str:
    """What links a row of means in the page's table to its points in charts; a scene's row has its job."""
    return " / ".join([str(row["dataset"]), row_label(row), str(row["preset"]), str(row["split"])])


class Model(NamedTuple):
    """A method with its options, which has one look in all charts; the default has no options."""

    method: str
    options: str = ""

    @property
    def title(self) -> str:
        """What charts call it."""
        return label(*self)


def model(method: Any, variant: Any) -> Model:
    """The model of a row with these two cells."""
    return Model(str(method), "" if absent(variant) else str(variant))


def models(*tables: pd.DataFrame) -> list[Model]:
    """The models of tables in order of appearance, which picks their looks."""
    pairs = (zip(table["method"], table["variant"], strict=True) for table in tables)
    return list(dict.fromkeys(model(*pair) for table in pairs for pair in table))


class Look(NamedTuple):
    """How a model is drawn: color, and marker and line."""

    color: str
    marker: str
    dash: str


OTHERS = Look("#A6A6A6", "circle", "solid")
"""Of models that are not told apart."""
OTHERS_NAME = "other variants"


def look(model: Model, models: Sequence[Model]) -> Look:
    """The color is the method's, the same in every chart of a report; variants differ in marker and line.

    Args:
        model: one of ``models``.
        models: all of the report (:func:`models`).
    """
    methods = list(dict.fromkeys(each.method for each in models))
    place = {method: i % len(PALETTE) for i, method in enumerate(methods)}
    hue = place[model.method]
    alike = [each for each in models if place[each.method] == hue]
    rank = sorted(alike, key=lambda each: each.options != "").index(model)
    turn = rank + rank // len(MARKERS)  # so that marker and line repeat together late
    return Look(PALETTE[hue], MARKERS[(hue + rank) % len(MARKERS)], DASHES[turn % len(DASHES)])


def named(models: Iterable[Model]) -> set[Model]:
    """Those models of a panel that are told apart.

    All up to :data:`MOST_NAMED`; of more, one per method: its default, or the first where it has none.
    """
    every = list(dict.fromkeys(models))
    if len(every) <= MOST_NAMED:
        return set(every)
    chosen: dict[str, Model] = {}
    for each in sorted(every, key=lambda each: each.options != ""):
        chosen.setdefault(each.method, each)
    return set(chosen.values())


def looks(
    panel: Mapping[Model, Model], models: Sequence[Model], apart: Iterable[Model] = ()
) -> dict[Model, Look]:
    """Model of a panel -> its look; those that are not told apart come first, to be drawn below.

    Args:
        panel: model -> the one of ``models`` that its look is of.
        models: all of the report.
        apart: of the panel, told apart in any case.
    """
    own = named(panel) | set(apart)
    ordered = sorted(panel, key=lambda each: each in own)
    return {each: look(panel[each], models) if each in own else OTHERS for each in ordered}


def legend_entries(panels: Iterable[Iterable[Model]], models: Sequence[Model]) -> dict[str, Look]:
    """What a legend of panels names: what they draw, in the order of the report; the gray ones together."""
    styles: dict[Model, Look] = {}
    for panel in panels:
        for each, style in looks({each: each for each in panel}, models).items():
            if style is not OTHERS or each not in styles:
                styles[each] = style
    entries = {each.title: styles[each] for each in models if styles.get(each, OTHERS) is not OTHERS}
    return entries | ({OTHERS_NAME: OTHERS} if OTHERS in styles.values() else {})


def seconds(value: float) -> str:
    """A duration for people: "4.2 ms", "0.42 s", "12.3 s", "3 min 20 s", "1 h 05 min"."""
    if value < 0.0995:
        return f"{value * 1e3:.1f} ms"
    if value < 9.995:
        return f"{value:.2f} s"
    if value < 60:
        return f"{value:.1f} s" if value < 59.95 else "1 min 00 s"
    whole = round(value)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def mib(value: float) -> str:
    """Bytes as MiB with three significant digits (paper tables: MB = MiB)."""
    size = value / MIB
    if size >= 100:
        return f"{size:,.0f}"
    return f"{size:.1f}" if size >= 10 else f"{size:.2f}" if size >= 0.1 else f"{size:.4f}"
