"""What the gate compares, and the scale on which repetitions of a number spread alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

from econgs_bench.reports.schema import by_name


@dataclass(frozen=True)
class Quantity:
    """A number of a cell.

    Attributes:
        name: column of the table `results`, or "train_ratio" or "frame_ratio".
        kind: "quality", "size" or "time".
        title: for people, with the unit.
        better: 1 if higher is better, -1 if lower is.
        scale: "linear", or "log" of the number (of SSIM: of 1 - number), where spread is relative.
        least: added to the number before its logarithm, so that zero counts as that little.
    """

    name: str
    kind: str
    title: str
    better: int
    scale: str = "log"
    least: float = 0.0

    def score(self, value: float) -> float:
        """The number on its scale; more is better."""
        if self.scale == "linear":
            return self.better * value
        amount = 1.0 - value if self.name == "ssim" else value
        sign = -1 if self.name == "ssim" else self.better
        return sign * math.log(max(amount, 0.0) + self.least)

    def error(self, value: float, rounding: float) -> float:
        """How far the score may be off, where the number is known to ``± rounding``."""
        return 0.5 * abs(self.score(value + rounding) - self.score(value - rounding))

    def text(self, value: float) -> str:
        """The number for people."""
        if self.kind == "time":
            return f"{value:.3g}"
        return by_name(self.name).text(value)

    def change(self, difference: float) -> str:
        """A difference of scores for people: in units, or as a factor."""
        if self.scale == "linear":
            return f"{self.better * difference:+.2f}"
        factor = math.exp(abs(difference))
        return f"{factor:,.0f} times" if factor >= 10.0 else f"{100.0 * (factor - 1.0):.3g} %"


def _column(name: str, kind: str, scale: str = "log", least: float = 0.0) -> Quantity:
    column = by_name(name)
    return Quantity(name, kind, column.header, column.better or -1, scale, least)


QUANTITIES: dict[str, Quantity] = {
    quantity.name: quantity
    for quantity in (
        _column("psnr", "quality", "linear"),
        _column("ssim", "quality", least=1e-4),
        _column("flip", "quality", least=1e-3),
        _column("delta_e_uv", "quality", least=1e-2),
        _column("missing", "quality", least=1e-3),
        _column("excess", "quality", least=1e-3),
        _column("size_bytes", "size", least=1.0),
        _column("primitives", "size", least=1.0),
        Quantity("train_ratio", "time", "Training (CPU) / kernel", -1),
        Quantity("frame_ratio", "time", "Frame / kernel", -1),
    )
}
"""Name -> quantity. Times are ratios to the reference kernel beside them, so the machine's pace cancels."""
