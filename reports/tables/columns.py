"""Columns of tables as people read them: titles, units, digits, and which end is better."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports.schema import by_name
from reports.style import MISSING, absent

if TYPE_CHECKING:
    import pandas as pd


def quality(table: pd.DataFrame) -> list[str]:
    """The quality metrics in the order they are shown: where LPIPS is missing, SSIM and FLIP lead."""
    if "lpips_vgg" in table and table["lpips_vgg"].notna().any():
        return ["psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv"]
    return ["ssim", "flip", "psnr", "psnr_fg", "delta_e_uv", "lpips_vgg"]


def is_results(table: pd.DataFrame) -> bool:
    """Whether a table is `results` as documented, not one made for people."""
    return {"job", "status", "variant"} <= set(table.columns)


def cell(name: str, value: Any) -> str:
    """One value as text in the column's unit; an en dash if it is missing."""
    return MISSING if absent(value) else by_name(name).text(value)
