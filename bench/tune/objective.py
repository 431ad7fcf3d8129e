"""What a trial is good for: the area under its front, or one of its points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from econgs_bench.datasets.errors import DataError

REFERENCE = (20.0, 64.0)
"""PSNR (dB) and size of a scene (MiB) at which the area of a front ends, unless others are named."""


@dataclass(frozen=True)
class Objective:
    """The score of a trial; the larger, the better.

    Attributes:
        kind: "front": area under the front of PSNR over the logarithm of size, dB x octaves; "point": that of
            the method's own size alone; "size": greatest PSNR of a model of at most that size, dB; "psnr":
            greatest PSNR, dB.
        text: as on the command line: "front=20,64", "point=20,64", "size=0.5" or "psnr".
        psnr: reference of a front or point, dB.
        mib: reference of a front or point, or size, MiB.
    """

    kind: Literal["front", "point", "size", "psnr"]
    text: str
    psnr: float = 0.0
    mib: float = math.inf

    @property
    def unit(self) -> str:
        return "dB x octaves" if self.has_reference else "dB"

    @property
    def has_reference(self) -> bool:
        """Whether models beyond a reference point score 0."""
        return self.kind in ("front", "point")

    @property
    def every_rate(self) -> bool:
        """Whether a trial has a model per rate, and not only one of the method's own size."""
        return self.kind in ("front", "size")

    @property
    def title(self) -> str:
        """The definition, for people."""
        if self.kind == "front":
            return f"area under PSNR over log2 of size, above {self.psnr:g} dB and below {self.mib:g} MiB"
        if self.kind == "point":
            return f"(PSNR - {self.psnr:g} dB) x log2({self.mib:g} MiB / size)"
        if self.kind == "size":
            return f"PSNR of a model of at most {self.mib:g} MiB"
        return "PSNR"

    def score(self, points: ArrayLike) -> float:
        """Score of the models of one scene.

        Where no model is as small as a size asks for, it is minus the octaves by which the smallest exceeds
        that size: less than any PSNR, and more for smaller models.

        Args:
            points: (n, 2) size in MiB and PSNR in dB, n >= 1.
        """
        table = np.asarray(points, dtype=np.float64)
        if self.has_reference:
            return hypervolume(table, (self.psnr, self.mib))
        fitting = table[table[:, 0] <= self.mib]
        if len(fitting):
            return float(fitting[:, 1].max())
        return -float(np.log2(table[:, 0].min() / self.mib))


def objective_of(text: str) -> Objective:
    """An objective by its text: "front", "front=DB,MIB", "point", "point=DB,MIB", "size=MIB" or "psnr".

    Raises:
        DataError: another text, or numbers out of range.
    """
    kind, _, rest = text.partition("=")
    try:
        numbers = [float(part) for part in rest.split(",")] if rest else []
    except ValueError:
        numbers = [math.nan]
    usable = all(map(math.isfinite, numbers)) and all(number > 0.0 for number in numbers[-1:])
    if usable and kind in ("front", "point") and len(numbers) in (0, 2):
        psnr, mib = numbers or REFERENCE
        return Objective(kind, f"{kind}={psnr:g},{mib:g}", psnr, mib)  # type: ignore[arg-type]
    if usable and kind == "size" and len(numbers) == 1:
        return Objective("size", f"size={numbers[0]:g}", mib=numbers[0])
    if text == "psnr":
        return Objective("psnr", text)
    raise DataError(
        f"--objective {text}",
        "no objective",
        "Write front, front=DB,MIB (its reference point), point=DB,MIB, size=MIB or psnr",
    )


def hypervolume(points: ArrayLike, reference: tuple[float, float]) -> float:
    """Area between the front of models and a reference point, dB x octaves.

    Args:
        points: (n, 2) size in MiB and PSNR in dB; those beyond the reference add nothing.
        reference: PSNR in dB and size in MiB.
    """
    table = np.asarray(points, dtype=np.float64)
    octaves = np.log2(reference[1] / table[:, 0]).clip(0.0)
    gains = (table[:, 1] - reference[0]).clip(0.0)
    order = np.argsort(-octaves)
    widths = -np.diff(octaves[order], append=0.0)
    return float(widths @ np.maximum.accumulate(gains[order]))


def front(points: ArrayLike) -> list[int]:
    """Positions of the points that no other point beats in size and PSNR, by size.

    Args:
        points: (n, 2) size and PSNR.
    """
    from econgs_bench.reports.fronts import pareto

    places: dict[tuple[float, float], int] = {}
    for place, (size, psnr) in enumerate(np.asarray(points, dtype=np.float64).tolist()):
        places.setdefault((size, psnr), place)
    return [places[point] for point in pareto(places, -1)]
