"""The noise floor: what the truth of a rendered scene itself reaches against truth of other rays.

Where a model comes near it, the rest of its error is the truth's own, and a lead there is no lead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from econgs_bench.reports.style import absent, counted

if TYPE_CHECKING:
    import pandas as pd

NEAR = 3.0
"""Distance to the floor in dB: there, half of the squared error is the truth's own."""


class Floor(NamedTuple):
    """What the truth, and one ray a pixel, reach: PSNR in dB."""

    truth: float
    one_ray: float | None

    def above(self, psnr: float) -> Floor:
        """How far both are above a PSNR."""
        return Floor(self.truth - psnr, None if self.one_ray is None else self.one_ray - psnr)


def by_scene(rows: Iterable[Mapping[str, Any]]) -> dict[str, Floor | None]:
    """Scene -> its floor, None where it is not known.

    Args:
        rows: of one truth a scene, with the columns `scene`, `floor` and `one_ray`.
    """
    found: dict[str, Floor | None] = {}
    for row in rows:
        scene = str(row["scene"])
        if found.get(scene) is None:
            found[scene] = of_row(row)
    return found


def of_row(row: Mapping[str, Any]) -> Floor | None:
    """The floor of a scene's row, or of a mean over scenes; None where it is not known."""
    truth, one_ray = row.get("floor"), row.get("one_ray")
    return None if absent(truth) else Floor(float(truth), None if absent(one_ray) else float(one_ray))  # type: ignore[arg-type]


def mean(floors: Iterable[Floor | None]) -> Floor | None:
    """The mean over scenes; None where that of a scene is not known."""
    every = list(floors)
    known = [one for one in every if one is not None]
    if not known or len(known) < len(every):
        return None
    rays = [one.one_ray for one in known if one.one_ray is not None]
    return Floor(fmean(one.truth for one in known), fmean(rays) if len(rays) == len(known) else None)


def of_table(rows: pd.DataFrame) -> Floor | None:
    """The mean over the scenes of a table of comparable rows."""
    names = [name for name in ("scene", "floor", "one_ray") if name in rows]
    return mean(by_scene(rows[names].to_dict("records")).values())  # type: ignore[arg-type]


def closeness(scenes: Iterable[tuple[Floor | None, float]]) -> str:
    """On how many scenes a comparison is at the floor, in words; "" where on none.

    Args:
        scenes: of each its floor and the highest PSNR of the compared methods, dB.
    """
    every = list(scenes)
    near = sum(floor is not None and best > floor.truth - NEAR for floor, best in every)
    of = counted(len(every), "scene")
    return f"within {NEAR:g} dB of the truth's own floor on {near} of {of}" if near else ""
