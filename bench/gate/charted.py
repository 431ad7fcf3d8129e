"""The values of a run as JSON, for services that chart them from commit to commit."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from statistics import fmean
from typing import NamedTuple

from econgs_bench.bench.gate.cells import Cell, Key
from econgs_bench.bench.gate.quantities import QUANTITIES


class _Point(NamedTuple):
    """Mean, least and greatest value of a quantity of a cell over its seeds."""

    cell: str
    quantity: str
    mean: float
    least: float
    greatest: float
    seeds: int


def charted(cells: Mapping[Key, Cell], form: str) -> str:
    """The values in the form of a service.

    Args:
        cells: of the run.
        form: "github-benchmark": the list of `customSmallerIsBetter` of benchmark-action, where PSNR is its
            RMSE in levels of 255 and SSIM its distance from 1. "bmf": Bencher's metric format.
    """
    points = list(_points(cells))
    if form == "bmf":
        table: dict[str, dict[str, dict[str, float]]] = {}
        for one in points:
            values = {"value": one.mean, "lower_value": one.least, "upper_value": one.greatest}
            table.setdefault(one.cell, {})[one.quantity] = values
        return json.dumps(table, indent=1)
    return json.dumps([_smaller_is_better(one) for one in points], indent=1)


def _points(cells: Mapping[Key, Cell]) -> Iterator[_Point]:
    for key, cell in cells.items():
        for name in QUANTITIES:
            values = [own[name] for own in cell.values.values() if name in own]
            if values:
                yield _Point(key.title, name, fmean(values), min(values), max(values), len(values))


def _smaller_is_better(one: _Point) -> dict[str, str | float]:
    turned = {
        "psnr": ("RMSE", "levels of 255", lambda value: 255.0 * 10.0 ** (-value / 20.0)),
        "ssim": ("1 - SSIM", "", lambda value: 1.0 - value),
    }
    title, unit, turn = turned.get(one.quantity, (QUANTITIES[one.quantity].title, "", lambda value: value))
    ends = sorted(map(turn, (one.least, one.greatest)))
    return {
        "name": f"{one.cell}: {title}",
        "unit": unit or "-",
        "value": turn(one.mean),
        "range": f"{ends[0]:.6g} to {ends[1]:.6g}",
        "extra": f"{one.seeds} seeds",
    }
