"""A sheet of pictures and captions for papers, as PDF and PNG."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.files import pdf
from econgs_bench.reports.text import printable

SIZE = 6.5
"""Size of captions in points."""
_INCH = 72.0  # points
_PIXELS = 96.0  # of SVG in an inch


class Sheet:
    """A drawing; all lengths are inches from the upper left corner.

    Args:
        width, height: of the sheet.
    """

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self._parts: list[str] = []

    def picture(
        self, pixels: NDArray[np.uint8], left: float, top: float, width: float, height: float
    ) -> None:
        """A picture (rows, columns, 3), every pixel of which is kept."""
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG")
        data = base64.b64encode(file.getvalue()).decode("ascii")
        self._parts.append(
            f'<image {_place(left, top, width, height)} preserveAspectRatio="none" '
            f'image-rendering="pixelated" href="data:image/png;base64,{data}"/>'
        )

    def frame(self, left: float, top: float, width: float, height: float, color: str, line: float) -> None:
        """A rectangle of lines, as wide as so many points."""
        self._parts.append(
            f'<rect {_place(left, top, width, height)} fill="none" stroke="{color}" stroke-width="{line}"/>'
        )

    def caption(
        self,
        left: float,
        top: float,
        text: str,
        *,
        size: float = SIZE,
        color: str = svg.INK,
        bold: bool = False,
    ) -> None:  # fmt: skip
        """Lines of text below an upper left corner."""
        for number, line in enumerate(printable(text).split("\n")):
            base = _INCH * (top + (number + 1) * line_height(size)) - 0.25 * size
            self._parts.append(svg.text(_INCH * left, base, line, size=size, color=color, bold=bold))

    @property
    def document(self) -> str:
        """The sheet as SVG."""
        box = f"{_INCH * self.width:.1f} {_INCH * self.height:.1f}"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_PIXELS * self.width:.1f}" '
            f'height="{_PIXELS * self.height:.1f}" viewBox="0 0 {box}" font-family="{svg.FONT}" '
            f'font-size="{svg.SIZE}" style="background:#ffffff">{"".join(self._parts)}</svg>'
        )


def line_height(size: float = SIZE) -> float:
    """Height of a line of text in inches."""
    return 1.2 * size / _INCH


def save(sheet: Sheet, folder: Path, name: str, dpi: int) -> None:
    """Write a sheet as PDF, the same bytes each time, and as PNG; the folder is created if it is missing."""
    import vl_convert

    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.pdf").write_bytes(pdf(sheet.document))
    (folder / f"{name}.png").write_bytes(vl_convert.svg_to_png(sheet.document, scale=dpi / _PIXELS))


def _place(left: float, top: float, width: float, height: float) -> str:
    numbers = zip(("x", "y", "width", "height"), (left, top, width, height), strict=True)
    return " ".join(f'{name}="{_INCH * value:.2f}"' for name, value in numbers)
