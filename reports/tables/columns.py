"""Choice and order of columns, and the text of cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.schema import METRICS, by_name
from econgs_bench.reports.style import MISSING, absent
from econgs_bench.reports.tables.grid import Field

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


def places(table: pd.DataFrame, keys: Sequence[str]) -> dict[tuple[Any, ...], NDArray[np.intp]]:
    """Values of some columns -> positions of their rows, both in order of appearance.

    Much faster than the parts of a `groupby` where there are thousands.
    """
    groups: dict[tuple[Any, ...], list[int]] = {}
    for place, key in enumerate(zip(*(table[name].tolist() for name in keys), strict=True)):
        groups.setdefault(key, []).append(place)
    return {key: np.array(at) for key, at in groups.items()}


def quality(table: pd.DataFrame) -> tuple[str, ...]:
    """The quality metrics in order of display; SSIM and FLIP come first where LPIPS is missing."""
    if "lpips_vgg" in table and table["lpips_vgg"].notna().any():
        return METRICS
    return ("ssim", "flip", "psnr", "psnr_fg", "delta_e_uv", "lpips_vgg")


def numbers(results: pd.DataFrame) -> list[str]:
    """The numbers of `results` that people read, in order of display: what decides comes first.

    One that no row has is left out, but for PSNR and size.
    """
    first, *others = sorted(quality(results), key=lambda name: name != "psnr")
    names = (
        first, "floor", "size_bytes", "train_seconds", "fps", "peak_host_bytes", "peak_device_bytes", *others,
        "primitives", "load_seconds",
    )  # fmt: skip
    return [name for name in names if name in ("psnr", "size_bytes") or results[name].notna().any()]


def axes(results: pd.DataFrame) -> list[str]:
    """The axes with several values in `results`, besides dataset, scene and method."""
    names = ("kind", "preset", "split", "seed", "device")
    return [name for name in names if results[name].nunique(dropna=False) > 1]


def is_results(table: pd.DataFrame) -> bool:
    """Whether a table is `results` of the schema."""
    return {"job", "status", "variant"} <= set(table.columns)


def cell(name: str, value: Any) -> str:
    """A value of the column ``name`` as text, without unit; an en dash if it is missing."""
    return MISSING if absent(value) else by_name(name).text(value)


def field(name: str, texts: list[str]) -> Field:
    """The column ``name`` of a terminal's table."""
    column = by_name(name)
    number = column.dtype in ("Int64", "Float64") or (column.numeric and column.dtype != "string")
    return Field(column.header, texts, "name" if name == "job" else "number" if number else "label")
