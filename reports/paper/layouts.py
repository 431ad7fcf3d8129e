"""How the paper's tables are laid out, and the values that it published (``published/``)."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parent / "published"


@cache
def layouts() -> dict[str, Any]:
    """What ``published/tables.toml`` says."""
    return tomllib.loads((_FOLDER / "tables.toml").read_text(encoding="utf-8"))


@cache
def reference_rows(name: str) -> list[dict[str, str]]:
    """The rows of ``published/NAME.csv``."""
    with (_FOLDER / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def reference(name: str, match: Mapping[str, str] | None, published: str) -> dict[str, str]:
    """The published row that answers to a line of a layout; {} where there is none."""
    for row in reference_rows(name) if match is not None else ():
        if row["dataset"] == published and all(row[key] == value for key, value in (match or {}).items()):
            return row
    return {}


def published_as(name: str, dataset: str) -> dict[str, Any]:
    """Dataset of a published table -> what the layouts say of it, where this one is it or imitates it."""
    told = {row["dataset"] for row in reference_rows(name)}
    return {
        published: about
        for published, about in layouts()["datasets"].items()
        if published in told and dataset in (*about.get("real", ()), *about.get("stand_ins", ()))
    }


def sole_dataset(name: str) -> str:
    """The dataset that a whole published table is about; "" if it is about several."""
    told = {row["dataset"] for row in reference_rows(name)}
    return told.pop() if len(told) == 1 else ""


def takes(name: str, dataset: str) -> bool:
    """Whether a table may show a dataset that is none of its published ones.

    Some tables compare methods only, as any run of several methods does: they name their suite's datasets.
    """
    others = layouts()["tables"][name].get("data")
    return others is None or dataset in others
