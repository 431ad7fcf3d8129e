"""One look for all charts: colors that the color-blind can tell apart, names and units."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pandas as pd

# Okabe & Ito (2008) without its yellow, which is too pale on white;
# indigo and wine of P. Tol's "muted"; brown.
BLUE, VERMILLION, GREEN, PINK, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9"
ORANGE, BROWN, INDIGO, WINE, BLACK = "#E69F00", "#6B4C1E", "#332288", "#882255", "#000000"
PALETTE = (BLUE, VERMILLION, GREEN, PINK, SKY, ORANGE, BROWN, INDIGO, WINE, BLACK)
DARK = {
    BLACK: "#ffffff", BLUE: "#4ba3dc", VERMILLION: "#f2803a", INDIGO: "#9d90e8", WINE: "#d8578f",
    BROWN: "#b9914f",
}  # fmt: skip
"""What would drown on dark -> what stands there instead."""
MARKERS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "star", "x", "cross")
DASHES = ("solid", "dash", "dot", "dashdot")
MOST_NAMED = 10
"""Models of a panel; of more, only each method's default has its color and name."""
MIB = float(2**20)
MISSING = "\N{EN DASH}"
TITLES = {
    "3dgs": "3DGS", "econgs": "ECoNGS-R", "scaffold-gs": "Scaffold-GS", "hac": "HAC", "ivr-gs": "iVR-GS",
    "vq-3dgs": "VQ-3DGS", "plenoxels": "Plenoxels", "ccnerf": "CCNeRF", "veg": "VEG",
    "mesh": "Triangle mesh", "sz3": "SZ3 volume", "zfp": "zfp volume", "3dgs-mcmc": "3DGS-MCMC",
    "hac-plus": "HAC++", "3dgs-coded": "3DGS, coded",
}  # fmt: skip


class Look(NamedTuple):
    """How a model is drawn: color, and marker and line."""

    color: str
    marker: str
    dash: str


LOOKS = {
    "3dgs": Look(BLUE, "circle", "solid"),
    "econgs": Look(VERMILLION, "square", "solid"),
    "scaffold-gs": Look(GREEN, "triangle-up", "solid"),
    "hac": Look(SKY, "triangle-down", "solid"),
    "hac-plus": Look(ORANGE, "star", "solid"),
    "ivr-gs": Look(PINK, "diamond", "solid"),
    "vq-3dgs": Look(WINE, "x", "solid"),
    "3dgs-mcmc": Look(INDIGO, "diamond", "solid"),
    "3dgs-coded": Look(BROWN, "triangle-up", "solid"),
    "plenoxels": Look(BLACK, "cross", "solid"),
    "ccnerf": Look(BLACK, "circle", "dash"),
    "veg": Look(BROWN, "circle", "dash"),
    "mesh": Look(INDIGO, "square", "dash"),
    "sz3": Look(GREEN, "diamond", "dash"),
    "zfp": Look(WINE, "triangle-up", "dash"),
}
"""Built-in method -> its look in every report."""
PAPER = "configuration=paper"
"""Option that gives a method the settings of its paper."""
PUBLISHED = {"econgs": "ECoNGS"}
"""Name of the published method, where this project's version has a name of its own."""
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
    """What a row is called in tables and charts.

    A method with the settings of its paper is called "NAME (published)": this project's version differs.
    """
    options = [] if absent(variant) else str(variant).split(",")
    if PAPER in options:
        options.remove(PAPER)
        parts = [f"{PUBLISHED.get(str(method)) or TITLES.get(str(method), str(method))} (published)"]
    else:
        parts = [TITLES.get(str(method), str(method))]
    if any(options):
        parts.append(f"[{','.join(options)}]")
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


def model_named(name: str) -> Model:
    """The model that conclusions call by this name: a method, or :func:`label` of one with options."""
    title, _, options = name.removesuffix("]").partition(" [")
    methods = {text: method for method, text in TITLES.items()}
    return Model(methods.get(title, title) if options else name, options)


def models(*tables: pd.DataFrame, column: str = "variant") -> list[Model]:
    """The models of tables in order of appearance; their options are in this column."""
    pairs = (zip(table["method"], table[column], strict=True) for table in tables)
    return list(dict.fromkeys(model(*pair) for table in pairs for pair in table))


OTHERS = Look("#A6A6A6", "circle", "solid")
"""Of models that are not told apart."""
OTHERS_NAME = "other variants"


def look(model: Model, models: Sequence[Model]) -> Look:
    """What a model looks like: its method's color, the same in every report.

    A built-in method has its look of :data:`LOOKS`. Any other has one that its name selects among those that
    no built-in method has. Variants of options have their method's color, and the marker and line that the
    options' text selects. Where two models of a report would look alike, the second in order of method and
    options has the next free look.

    Args:
        model: any.
        models: all of the report (:func:`models`).
    """
    every = _looks(tuple(models))
    return every[model] if model in every else _looks((*models, model))[model]


@lru_cache(maxsize=64)
def _looks(models: tuple[Model, ...]) -> dict[Model, Look]:
    """The looks of a report's models."""
    methods = sorted({each.method for each in models})
    given = {method: LOOKS[method] for method in methods if method in LOOKS}
    fixed = {(each.color, each.dash) for each in LOOKS.values()}
    spare = [look for look in map(Look._make, product(PALETTE, MARKERS, DASHES)) if look[::2] not in fixed]
    for method in methods:
        if method not in given:
            aspects = _color, _in_its_color, _whole
            given[method] = _free(spare, method, given.values(), aspects)
    looks = {Model(method): look for method, look in given.items()}
    for each in sorted(set(models) - set(looks)):
        color = given[each.method].color
        alike = [look for look in looks.values() if look.color == color]
        own = [Look(color, *line) for line in product(MARKERS, DASHES)]
        looks[each] = _free(own, each.options, [*alike, *LOOKS.values()], (_marker, _whole))
    return looks


def _free(
    candidates: list[Look], name: str, taken: Iterable[Look], aspects: Sequence[Callable[[Look], set[Any]]]
) -> Look:
    """The candidate that a name selects, or the next of which nobody has the first aspect, else the second.

    Where all are taken, two look alike.
    """
    start = zlib.crc32(name.encode()) % len(candidates)
    ring = candidates[start:] + candidates[:start]
    for aspect in aspects:
        used = set().union(*map(aspect, taken))
        for one in ring:
            if not aspect(one) & used:
                return one
    return ring[0]


def _color(look: Look) -> set[Any]:
    return {look.color}


def _marker(look: Look) -> set[Any]:
    """Its color and marker: charts of points show no line."""
    return {(look.color, look.marker)}


def _in_its_color(look: Look) -> set[Any]:
    return {(look.color, look.marker), (look.color, look.dash)}


def _whole(look: Look) -> set[Any]:
    return {look}


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


def looks(panel: Iterable[Model], models: Sequence[Model], apart: Iterable[Model] = ()) -> dict[Model, Look]:
    """Model of a panel -> its look; those that are not told apart come first, to be drawn below.

    Args:
        panel: models of a panel.
        models: all of the report.
        apart: of the panel, told apart in any case.
    """
    every = list(dict.fromkeys(panel))
    own = named(every) | set(apart)
    ordered = sorted(every, key=lambda each: each in own)
    return {each: look(each, models) if each in own else OTHERS for each in ordered}


def legend_entries(panels: Iterable[Iterable[Model]], models: Sequence[Model]) -> dict[str, Look]:
    """What a legend of panels names: what they draw, in the order of the report; the gray ones together."""
    styles: dict[Model, Look] = {}
    for panel in panels:
        for each, style in looks(panel, models).items():
            if style is not OTHERS or each not in styles:
                styles[each] = style
    entries = {each.title: styles[each] for each in models if styles.get(each, OTHERS) is not OTHERS}
    return entries | ({OTHERS_NAME: OTHERS} if OTHERS in styles.values() else {})


def ends(low: float | None, high: float | None, sign: bool = False) -> str:
    """An interval as "-0.56 to -0.003", with enough digits that an end unlike zero is not printed as zero."""
    if absent(low) or absent(high):
        return MISSING
    low, high = float(low or 0.0), float(high or 0.0)
    apart = low > 0 or high < 0
    enough = (n for n in range(2, 6) if not apart or (round(low, n) and round(high, n)))
    digits = next(enough, 6)
    return f"{signed(low, digits, sign)} to {signed(high, digits, sign)}"


def signed(value: float, digits: int = 2, sign: bool = True) -> str:
    """A number with a true minus sign; never "-0.00"."""
    rounded = round(value, digits) + 0.0
    text = f"{rounded:+.{digits}f}" if sign else f"{rounded:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}")


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
