"""Rows that answer different questions are kept apart before anything is averaged or ranked."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

ORIGIN = "whole_dataset"
_CONDITIONS = ("preset", "split")


def comparable(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Title and rows of each dataset at one preset and split: what one chart may compare.

    Preset and split are in the title where the table has several.
    """
    axes = ["dataset", *(axis for axis in _CONDITIONS if axis in table)]
    shown = [axis == "dataset" or table[axis].nunique() > 1 for axis in axes]
    for keys, rows in table.groupby(axes, dropna=False, sort=False):
        yield " \N{MIDDLE DOT} ".join(str(key) for key, told in zip(keys, shown, strict=True) if told), rows


def shared_by_all(seeds: Iterable[Iterable[Any]]) -> set[Any]:
    """The seeds that all of several settings were measured with; all seeds where none is."""
    sets = [set(each) for each in seeds]
    return (set.intersection(*sets) or set.union(*sets)) if sets else set()


def together(dataset: str, count: int) -> str:
    """What a dataset is called of which so many scenes were learned together, and elsewhere more."""
    return f"{dataset}, {count} scenes together" if count > 1 else f"{dataset}, scenes alone"


def whole(dataset: str) -> str:
    """The dataset itself of a name that :func:`together` made."""
    return re.sub(r", (\d+ scenes together|scenes alone)$", "", dataset)


def by_training_views(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """A dataset fitted with several numbers of training views at one preset becomes one dataset for each.

    "vortices" with fits from 6 and from 42 views becomes "vortices, 6 views" and "vortices, 42 views" in all
    tables; one with a number per preset keeps its name. The tables given stay as they are; renamed ones have
    the former name in a column :data:`ORIGIN`.
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
    return named.loc[_order(table, apart)].reset_index(drop=True)


def _order(table: pd.DataFrame, apart: pd.Series) -> pd.Index:
    """Datasets stay where they were; within one, few views come first."""
    place = {name: i for i, name in enumerate(dict.fromkeys(table["dataset"]))}
    keys = [
        (place[name], int(count) if split else 0)
        for name, count, split in zip(table["dataset"], table["requested_views"], apart, strict=True)
    ]
    ranked = sorted(range(len(keys)), key=keys.__getitem__)
    return table.index[ranked]
