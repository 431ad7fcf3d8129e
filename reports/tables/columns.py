"""Choice and order of columns, and the text of cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports.schema import METRICS, by_name
from reports.style import MISSING, absent

if TYPE_CHECKING:
    import pandas as pd


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table; much faster than `iterrows`."""
    return table.to_dict("records")  # type: ignore[return-value]


def quality(table: pd.DataFrame) -> tuple[str, ...]:
    """The quality metrics in order of display; SSIM and FLIP come first where LPIPS is missing."""
    if "lpips_vgg" in table and table["lpips_vgg"].notna().any():
        return METRICS
    return ("ssim", "flip", "psnr", "psnr_fg", "delta_e_uv", "lpips_vgg")


def numbers(results: pd.DataFrame) -> tuple[str, ...]:
    """The numbers of `results` that people read, in order of display."""
    return (
        *quality(results), "size_bytes", "primitives", "train_seconds", "load_seconds", "fps",
        "peak_host_bytes", "peak_device_bytes",
    )  # fmt: skip


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
