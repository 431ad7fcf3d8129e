"""Layouts of the paper's tables, and its published values (``published/``)."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "published"
"""Tables of published values, layouts and claims."""


@cache
def layouts() -> dict[str, Any]:
    """The content of ``published/tables.toml``."""
    return tomllib.loads((FOLDER / "tables.toml").read_text(encoding="utf-8"))


@cache
def reference_rows(name: str) -> list[dict[str, str]]:
    """The rows of ``published/NAME.csv``."""
    with (FOLDER / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def reference(name: str, match: Mapping[str, str] | None, published: str) -> dict[str, str]:
    """The published row for a line of a layout; {} if there is none."""
    for row in reference_rows(name) if match is not None else ():
        if row["dataset"] == published and all(row[key] == value for key, value in (match or {}).items()):
            return row
    return {}


def rivals(line: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a line of a layout is about: only lines with equal scenes and training views are compared."""
    return line.get("scene"), bool(line.get("composed")), line.get("train_views")


def published_as(name: str, dataset: str) -> dict[str, Any]:
    """Published dataset -> its description in the layouts, if ``dataset`` is it or imitates it."""
    datasets = {row["dataset"] for row in reference_rows(name)}
    return {published: one for published, one in known_as(dataset).items() if published in datasets}


def known_as(dataset: str) -> dict[str, Any]:
    """Published dataset -> its description, of all that ``dataset`` is or imitates, wholly or in part."""
    name = dataset.partition("@")[0]
    return {
        published: one
        for published, one in layouts()["datasets"].items()
        if name in (*one.get("real", ()), *one.get("stand_ins", ()))
    }


def sole_dataset(name: str) -> str:
    """The only dataset of a published table; "" if the table has several."""
    datasets = {row["dataset"] for row in reference_rows(name)}
    return datasets.pop() if len(datasets) == 1 else ""


def takes(name: str, dataset: str) -> bool:
    """Whether a table accepts a dataset that is not one of its published ones.

    A table that only compares methods would accept any run of several methods. Such a table lists the
    datasets of its suite.
    """
    others = layouts()["tables"][name].get("data")
    return others is None or dataset in others
