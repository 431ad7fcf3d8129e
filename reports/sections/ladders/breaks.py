"""Pictures of ladders as files for papers: the first breaks of each method, and the flicker of all."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.sheet import Sheet, save
from econgs_bench.reports.sections.ladders.conclusion import amount
from econgs_bench.reports.sections.ladders.strips import FACTOR, Flicker, ViewsOfJobs, psnr_of, read_pair
from econgs_bench.reports.sections.ladders.table import Row
from econgs_bench.reports.style import label

RULE = (
    "Each break has three pictures: the ground truth of its rung, the method on that rung, and the method on "
    "the usual run. The view is the one that loses most PSNR; where test pictures differ from rung to rung, "
    "it is each rung's view with the lowest PSNR."
)
_COLUMNS = 3
_CELL, _GAP, _SPACE, _TEXT = 0.82, 0.04, 0.16, 0.13  # inches
_CAPTION = 16
"""Letters that fit under a picture."""
_DPI = 120
_LETTERS = 44  # letters of a line above three pictures

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Break:
    """The first break of a method on a ladder.

    Attributes:
        ladder, rung, subject: where; the subject is a scene, "" where rungs are scenes.
        kind: of the break, with the amount that decides it.
        truth: (height, width, 3) ground truth of the rung.
        broken: the method on the rung.
        usual: the method on the usual run; None without one, or without its pictures.
    """

    ladder: str
    rung: str
    subject: str
    kind: str
    truth: Picture
    broken: Picture
    usual: Picture | None


def breaks_of(climbs: Sequence[Row], rows: Sequence[Row], views: ViewsOfJobs, root: Path) -> list[Break]:
    """The first breaks that have pictures (a failed step has none), the earliest first.

    Args:
        climbs: of one method, as of :func:`.reports.sections.ladders.conclusion.by_method`.
        rows: of :func:`.reports.sections.ladders.table.ladders`.
        views: by job.
        root: folder that the paths in ``views`` are relative to.
    """
    by_job = {row["job"]: row for row in rows if row["job"] is not None}
    breaks = []
    for climb in climbs:
        row = by_job.get(climb["job"])
        if climb["failure"] is None or row is None:
            continue
        broken, usual = views.get(row["job"], {}), views.get(row["first_job"], {})
        levels, first = psnr_of(broken), psnr_of(usual)
        if not levels:
            continue
        if row["same_truth"] and levels.keys() & first.keys():
            view = max(sorted(levels.keys() & first.keys()), key=lambda name: first[name] - levels[name])
            other = view
        else:
            view = min(sorted(levels), key=lambda name: levels[name])
            other = min(sorted(first), key=lambda name: first[name]) if first else ""
        pair = read_pair(broken[view], root)
        if pair is None:
            continue
        before = read_pair(usual[other], root) if other and climb["subject"] else None
        kind = ", ".join(filter(None, [climb["failure"], amount(climb)]))
        breaks.append(
            Break(
                climb["ladder"],
                climb["rung"],
                climb["subject"],
                kind,
                *pair,
                None if before is None else before[1],
            )
        )
    return breaks


def write_breaks(breaks: Sequence[Break], folder: Path, name: str) -> None:
    """Write breaks of a method as ``name.png`` and ``.pdf``."""
    save(draw_breaks(breaks), folder, name, _DPI)


def write_flicker(pair: Flicker, folder: Path) -> None:
    """Write ``flicker.png`` and ``.pdf``, the truth beside the change of error of each method."""
    save(draw_flicker(pair), folder, "flicker", _DPI)


def draw_breaks(breaks: Sequence[Break]) -> Sheet:
    """A grid of breaks, three pictures each."""
    columns = min(_COLUMNS, len(breaks))
    lines = [_words(one) for one in breaks]
    rows = [range(start, min(start + columns, len(breaks))) for start in range(0, len(breaks), columns)]
    heads = [_TEXT * max(lines[at].count("\n") + 1 for at in row) + 0.05 for row in rows]
    wide = 3 * _CELL + 2 * _GAP
    width = columns * (wide + _SPACE) + _SPACE
    sheet = Sheet(width, sum(heads) + len(rows) * (_CELL + _TEXT + _SPACE) + _GAP)
    top = _GAP
    for row, head in zip(rows, heads, strict=True):
        for column, at in enumerate(row):
            left = _SPACE + column * (wide + _SPACE)
            sheet.caption(left, top, lines[at], bold=True)
            shots = (
                ("truth", breaks[at].truth),
                (_caption(breaks[at].rung), breaks[at].broken),
                ("as usual", breaks[at].usual),
            )
            for place, (name, picture) in enumerate(shots):
                if picture is not None:
                    _show(sheet, picture, left + place * (_CELL + _GAP), top + head, name)
        top += head + _CELL + _TEXT + _SPACE
    return sheet


def _caption(text: str) -> str:
    """A caption that is no wider than its picture."""
    return text if len(text) <= _CAPTION else f"{text[: _CAPTION - 1]}\N{HORIZONTAL ELLIPSIS}"


def draw_flicker(pair: Flicker) -> Sheet:
    """A row of pictures: the truth, and the amplified change of error of each method."""
    shots = [("truth", pair.truth)]
    shots += [(f"{label(*name)}: {pair.amounts[name]:.2f}", change) for name, change in pair.changes.items()]
    sheet = Sheet(
        len(shots) * (_CELL + _GAP) + 2 * _SPACE - _GAP, _TEXT + 0.05 + _CELL + _TEXT + _GAP + _SPACE
    )
    words = f"{pair.subject}, {pair.views[0]} to {pair.views[1]}: change of the error, {FACTOR} times"
    sheet.caption(_SPACE, _GAP, words, bold=True)
    for place, (name, picture) in enumerate(shots):
        _show(sheet, picture, _SPACE + place * (_CELL + _GAP), _GAP + _TEXT + 0.05, name)
    return sheet


def _show(sheet: Sheet, picture: Picture, left: float, top: float, name: str) -> None:
    """A picture that fits a cell, with its name below the cell."""
    height, width = picture.shape[:2]
    scale = _CELL / max(height, width)
    sheet.picture(picture, left, top, width * scale, height * scale)
    sheet.caption(left, top + _CELL + 0.02, name, size=5.5, color="#555555")


def _words(one: Break) -> str:
    where = f"{one.ladder}, {one.subject}" if one.subject else one.ladder
    return "\n".join(textwrap.wrap(f"{where}: {one.kind}", _LETTERS))
