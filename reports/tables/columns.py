"""Columns of tables as people read them: titles, units, digits, and which end is better."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from reports.style import MISSING, absent, mib, seconds

if TYPE_CHECKING:
    import pandas as pd


class Column(NamedTuple):
    """How a column is shown.

    Attributes:
        title: header with unit.
        write: value -> text; called on values that are present.
        better: 1 if higher is better, -1 if lower is, 0 if it is not ranked.
        doc: tooltip of the header.
    """

    title: str
    write: Callable[[Any], str]
    better: int = 0
    doc: str = ""


def _fixed(digits: int) -> Callable[[Any], str]:
    return lambda value: f"{value:.{digits}f}"


def _significant(value: float) -> str:
    return f"{value:.5g}"


def _three(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _fps(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.3f}"


COLUMNS: dict[str, Column] = {
    "dataset": Column("Dataset", str),
    "scene": Column("Scene", str),
    "method": Column("Method", str),
    "scenes": Column("Scenes", str),
    "seeds": Column("Seeds", str),
    "psnr": Column("PSNR [dB]", _fixed(2), 1, "mean over views; per image on 8-bit composited RGB"),
    "psnr_std": Column("± [dB]", _fixed(2), 0, "standard deviation of PSNR over seeds"),
    "psnr_fg": Column("PSNR fg [dB]", _fixed(2), 1, "over pixels where truth or model has alpha >= 1/255"),
    "ssim": Column("SSIM", _fixed(4), 1, "Gaussian 11x11, sigma 1.5, interior"),
    "lpips_vgg": Column("LPIPS", _fixed(4), -1, "VGG, input in [-1, 1]"),
    "lpips_vgg01": Column("LPIPS [0,1]", _fixed(4), -1, "VGG, unscaled input in [0, 1]"),
    "lpips_alex": Column("LPIPS Alex", _fixed(4), -1, "AlexNet, input in [-1, 1]"),
    "flip": Column("FLIP", _fixed(4), -1, "mean, 67 pixels per degree"),
    "delta_e_uv": Column("ΔE*uv", _fixed(2), -1, "mean CIELUV color difference, D65"),
    "size_bytes": Column("Size [MiB]", mib, -1,
                         "bytes of the files that load opens; the scene's share of its group"),
    "primitives": Column("Primitives", lambda value: f"{int(value):,}"),
    "train_seconds": Column("Training", seconds, -1, "partition + fit + encode; the scene's share"),
    "load_seconds": Column("Load", seconds, -1, "from files to a model ready to render"),
    "fps": Column("FPS", _fps, 1, "1 / median frame time, camera to image, of the loaded model"),
    "peak_host_bytes": Column("Host mem. [MiB]", mib, -1, "peak of fit and measurement"),
    "peak_device_bytes": Column("Device mem. [MiB]", mib, -1, "peak device memory"),
    "status": Column("Status", str),
    "reason": Column("Reason", str),
    # Of rendering the volumes themselves.
    "resolution": Column("Resolution", str),
    "variables": Column("Variables", _significant),
    "volume_gib": Column("Volume [GiB]", _three),
    "cpu_gib": Column("CPU mem. [GiB]", _three, 0, "peak of the process that renders"),
    "gpu_gib": Column("GPU mem. [GiB]", _three, 0, "peak device memory"),
    "ms_per_view": Column("ms per view", _three, 0, "median of one view per launch, after warm-up"),
    "ms_p05": Column("5 %", _three),
    "ms_p95": Column("95 %", _three),
    "setup_seconds": Column("Set-up", seconds, 0, "from the volume in memory to the first picture"),
    "image": Column("Image", str),
    "renderer": Column("Renderer", str),
    "file": Column("Image", str),
    # Of the comparison of two runs.
    "views": Column("Views", _significant),
    "first": Column("First", _significant),
    "second": Column("Second", _significant),
    "difference": Column("Difference", _significant, 0, "second - first, mean over the paired views"),
    "least": Column("Least", _significant, 0, "difference of any view"),
    "greatest": Column("Greatest", _significant, 0, "difference of any view"),
    "identical": Column("Identical", lambda value: "yes" if value else "no"),
}  # fmt: skip


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
    if absent(value):
        return MISSING
    column = COLUMNS.get(name)
    if column is not None:
        return column.write(value)
    return _significant(value) if isinstance(value, float) else str(value)


def title(name: str) -> str:
    """A column's header."""
    return COLUMNS[name].title if name in COLUMNS else name.replace("_", " ").capitalize()


def numeric(name: str) -> bool:
    """Whether a column holds numbers, which align right."""
    return name in COLUMNS and COLUMNS[name].write is not str
