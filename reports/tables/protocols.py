"""Protocols: rows are averaged and ranked only among rows that answer the same question."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.style import absent, label

if TYPE_CHECKING:
    import pandas as pd

ORIGIN = "whole_dataset"
GROUPING = "grouping"
"""Column of tables by protocol: words on the scenes that were learned together, where others are usual."""
_CONDITIONS = ("preset", "split")
_DRAWING = re.compile(r"(?:^|,)(samples=\d+)(?=,|$)")
_SETTING = (
    "dataset", "scene", "kind", "edit", "preset", "split", "requested_views", "method", "variant", "rate",
)  # fmt: skip
_MODEL = ("dataset", "scene", "preset", "split", "requested_views", "seed", "rate")


def comparable(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Title and rows of each dataset at one preset and split: the rows that one chart compares.

    The title has preset and split if the table has several.
    """
    axes = ["dataset", *(axis for axis in _CONDITIONS if axis in table)]
    titled = [axis == "dataset" or table[axis].nunique() > 1 for axis in axes]
    for keys, rows in table.groupby(axes, dropna=False, sort=False):
        yield " \N{MIDDLE DOT} ".join(str(key) for key, used in zip(keys, titled, strict=True) if used), rows


def conditions(row: Any, table: pd.DataFrame) -> list[str]:
    """Preset and split of a row, each where the table has several."""
    return [str(row[axis]) for axis in _CONDITIONS if table[axis].nunique(dropna=False) > 1]


def shared_by_all(seeds: Iterable[Iterable[Any]]) -> set[Any]:
    """The seeds that all settings have; all seeds if they have none in common."""
    sets = [set(each) for each in seeds]
    return (set.intersection(*sets) or set.union(*sets)) if sets else set()


def of_shared_seeds(
    table: pd.DataFrame, places: Sequence[str], models: Sequence[str] = ("method", "variant")
) -> pd.DataFrame:
    """The rows of each place whose seed all its models have; all of its rows where they share none.

    Args:
        table: with ``seed``, the places and the models' columns.
        places: columns that name what models are compared on.
        models: columns that name a model.
    """
    place = [table[name].astype("string").fillna("") for name in places]
    first, *others = (table[name].astype("string").fillna("") for name in models)
    model = first
    for other in others:
        model = model.str.cat(other, sep=" ")
    owners = model.groupby([*place, table["seed"]], dropna=False).transform("nunique")
    shared = owners == model.groupby(place).transform("nunique")
    return table[shared | ~shared.groupby(place).transform("any")]


def finished(table: pd.DataFrame) -> pd.Series[bool]:
    """Of each row: whether the setting of its scene failed with no seed; others would be luckier."""
    keys = [name for name in _SETTING if name in table]
    return ~(table["status"] != "ok").groupby([table[name] for name in keys], dropna=False).transform("any")


def by_protocol(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Tables with a model for each choice of scenes and a dataset for each number of training views.

    Volumes that were measured or simulated precede those made by a formula.
    """
    tables = _procedural_last(tables)
    return by_training_views({name: by_scene_choice(table) for name, table in tables.items()})


def _procedural_last(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    results = tables["results"]
    if "procedural" not in results:  # a table made from results, as that of a comparison
        return tables
    made = set(results.loc[results["procedural"].fillna(False).astype(bool), "dataset"])
    return {
        name: table.sort_values(
            "dataset", key=lambda names: names.isin(made), kind="stable", ignore_index=True
        )
        for name, table in tables.items()
    }


def by_scene_choice(table: pd.DataFrame) -> pd.DataFrame:
    """Name models with ``scenes_together`` by it, as "ECoNGS [3 scenes together]" or "ECoNGS [scenes alone]".

    What a joint method learned from fewer scenes is another model of the same truth, beside the usual one: as
    though it were an option. The column :data:`GROUPING` has the words.
    """
    if "scenes_together" not in table:
        return table
    counts = table["scenes_together"].fillna(0).astype(int).tolist()
    words = [{0: "", 1: "scenes alone"}.get(count, f"{count} scenes together") for count in counts]
    if "contents" in table:
        words = _with_names(table, words)
    named = {GROUPING: words}
    for column in {"variant", "base"} & set(table.columns):
        texts = ["" if absent(text) else str(text) for text in table[column]]
        named[column] = [",".join(filter(None, pair)) for pair in zip(texts, words, strict=True)]
    import pandas as pd

    types = {name: table[name].dtype if name in table else "string[python]" for name in named}
    return table.assign(
        **{name: pd.Series(values, table.index, dtype=types[name]) for name, values in named.items()}
    )


def _with_names(table: pd.DataFrame, words: list[str]) -> list[str]:
    """Words on scenes that were learned together, with their names where several sets have as many scenes."""
    fitted = ["" if absent(text) else ", ".join(sorted(json.loads(text))) for text in table["contents"]]
    several: dict[tuple[str, str], set[str]] = {}
    for dataset, word, names in zip(table["dataset"], words, fitted, strict=True):
        several.setdefault((str(dataset), word), set()).add(names)
    return [
        f"{word}: {names}" if "together" in word and len(several[str(dataset), word]) > 1 else word
        for dataset, word, names in zip(table["dataset"], words, fitted, strict=True)
    ]


def without_drawing(variant: str) -> str:
    """Options of a row but for the number of points that a pixel is drawn by."""
    return _DRAWING.sub("", variant).removeprefix(",")


def drawn_as_means(results: pd.DataFrame) -> pd.DataFrame:
    """Results with one row per model: of a method that draws points, the drawing that the truth has.

    Such a method has a row whose pixels are means beside the one as published (``samples=16``). Where all of
    its models have both, the means take part in conclusions, under their name, with their quality and their
    frames per second; else those as published do.
    """
    variants = ["" if absent(text) else str(text) for text in results["variant"]]
    drawings = [match[1] if (match := _DRAWING.search(text)) else "" for text in variants]
    if not any(drawings):
        return results
    models: dict[str, dict[str, set[tuple[Any, ...]]]] = {}
    keys = [
        (*("" if absent(cell) else cell for cell in cells), without_drawing(variant))
        for variant, *cells in zip(variants, *(results[name] for name in _MODEL), strict=True)
    ]
    for method, drawing, key in zip(results["method"], drawings, keys, strict=True):
        models.setdefault(str(method), {}).setdefault(drawing, set()).add(key)
    chosen = {
        method: max(
            (one for one, drawn in own.items() if drawn >= own.get("", set())),
            key=lambda one: int(one.removeprefix("samples=") or 1),
        )
        for method, own in models.items()
    }
    pairs = list(zip(results["method"], drawings, strict=True))
    names = [label(method, drawing) if drawing else method for method, drawing in pairs]
    named = results.assign(method=names).astype({"method": results["method"].dtype})
    kept: pd.DataFrame = named[[chosen[str(method)] == drawing for method, drawing in pairs]]
    return kept


def contestants(results: pd.DataFrame) -> pd.DataFrame:
    """Results whose methods are named by the scenes that were learned together, where others are usual.

    Conclusions rank them beside the usual models; the names are those of :func:`.reports.style.label`.
    """
    if GROUPING not in results:
        return results
    names = [
        method if not words else label(method, words)
        for method, words in zip(results["method"], results[GROUPING], strict=True)
    ]
    return results.assign(method=names).astype({"method": results["method"].dtype})


def by_training_views(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Split each dataset that has several numbers of training views at one preset into one per number.

    "vortices" with fits from 6 and from 42 views becomes "vortices, 6 views" and "vortices, 42 views" in all
    tables. A dataset with one number per preset keeps its name. The result has copies of the tables with
    such datasets, with the original name in a column :data:`ORIGIN`.
    """
    results = tables["results"]
    if results.empty or "requested_views" not in results:
        return tables
    numbers = results.groupby(["dataset", "preset"], dropna=False)["requested_views"]
    mixed = results[(numbers.transform("nunique") > 1) & results["requested_views"].notna()]
    several = set(zip(mixed["dataset"], mixed["requested_views"], strict=True))
    return {name: _named(table, several) for name, table in tables.items()}


def _named(table: pd.DataFrame, several: set[tuple[str, int]]) -> pd.DataFrame:
    import pandas as pd

    if "requested_views" not in table:
        return table
    pairs = zip(table["dataset"], table["requested_views"], strict=True)
    apart = pd.Series([pair in several for pair in pairs], table.index, dtype=bool)
    if not apart.any():
        return table
    names = table["dataset"] + ", " + table["requested_views"].astype("string") + " views"
    named = table.assign(dataset=table["dataset"].where(~apart, names), **{ORIGIN: table["dataset"]})
    return named.loc[_order(table["dataset"], table["requested_views"].where(apart, 0))].reset_index(
        drop=True
    )


def _order(datasets: pd.Series, counts: pd.Series) -> pd.Index:
    """Rows in the order of their datasets; within a dataset by a count."""
    place = {name: i for i, name in enumerate(dict.fromkeys(datasets))}
    keys = [(place[name], int(count)) for name, count in zip(datasets, counts, strict=True)]
    ranked = sorted(range(len(keys)), key=keys.__getitem__)
    return datasets.index[ranked]
