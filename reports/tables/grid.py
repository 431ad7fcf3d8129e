"""A table of text in a given width: numbers and names of jobs are never cut, labels wrap."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from typing import NamedTuple

GAP = 2
"""Blanks between two columns."""
LEAST, USUAL = 12, 16
"""Characters to which a column of labels may shrink, at all and before a column is left out for it."""
_WORD = 20
"""Words of at most so many characters are broken last."""
_PIECE = re.compile(r"[^ ,|/+]*[ ,|/+]*")
"""A label may be broken behind these signs."""


def cell_len(text: str) -> int:
    """Characters of a terminal that a text takes: wide signs take two, combining ones none."""
    if text.isascii():
        return len(text)
    wide = sum(unicodedata.east_asian_width(sign) in "WF" for sign in text)
    return len(text) + wide - sum(map(bool, map(unicodedata.combining, text)))


class Field(NamedTuple):
    """A column.

    Attributes:
        header: broken between words where room is short.
        cells: one per row.
        kind: "label" wraps; "number" stands whole on the right; "name" stays whole on one line, to be
            copied.
    """

    header: str
    cells: list[str]
    kind: str = "label"

    def least(self, most: int = LEAST, words: int = _WORD) -> int:
        """Least width; labels take at most ``most``, or as much as their longest word of ``words`` signs."""
        head = max(map(cell_len, self.header.split()), default=0)
        longest = max(map(cell_len, self.cells), default=0)
        if self.kind != "label":
            return max(head, longest)
        pieces = {piece.rstrip() for cell in self.cells for piece in _PIECE.findall(cell)}
        word = min(max(map(cell_len, pieces), default=0), words)
        return max(head, min(longest, max(most, word)))

    def whole(self) -> int:
        """Width in which nothing is broken."""
        return max(map(cell_len, (self.header, *self.cells)))


def needed(fields: Iterable[Field], most: int = USUAL) -> int:
    """Width of a table whose labels shrink to at most ``most`` characters."""
    return sum(field.least(most) + GAP for field in fields) - GAP


def to_lines(fields: Sequence[Field], width: int) -> list[str]:
    """Header and rows in at most ``width`` characters; more only where numbers and names alone take more.

    Args:
        fields: columns of equally many cells.
        width: in characters.
    """
    widths = _widths(fields, width)
    texts = [[field.header for field in fields], *zip(*(field.cells for field in fields), strict=True)]
    rows = [[_broken(text, n) for text, n in zip(row, widths, strict=True)] for row in texts]
    lines = []
    for number, row in enumerate(rows):
        height = max(map(len, row), default=0)
        for line in range(height):
            cells = []
            for field, parts, n in zip(fields, row, widths, strict=True):
                at = line - (height - len(parts)) if number == 0 else line  # headers stand on their columns
                text = parts[at] if 0 <= at < len(parts) else ""
                blank = " " * (n - cell_len(text))
                cells.append(blank + text if field.kind == "number" else text + blank)
            lines.append((" " * GAP).join(cells).rstrip())
    return lines


def _widths(fields: Sequence[Field], width: int) -> list[int]:
    """Whole columns if they fit; else headers break, then the widest labels."""
    room = width - GAP * (len(fields) - 1)
    widths = [field.whole() for field in fields]
    if sum(widths) <= room:
        return widths
    widths = [field.least(field.whole()) for field in fields]
    for least in ([field.least() for field in fields], [field.least(words=0) for field in fields]):
        while sum(widths) > room:
            place = max(range(len(fields)), key=lambda i: (widths[i] > least[i], widths[i]))
            if widths[place] <= least[place]:
                break
            widths[place] -= 1
    return widths


def _broken(text: str, width: int) -> list[str]:
    """A text in lines of at most ``width`` characters; those after the first are indented."""
    if cell_len(text) <= width:
        return [text]
    indent = "  " if width >= LEAST else ""
    lines, line = [], ""
    for piece in _PIECE.findall(text):
        if line.strip() and cell_len(line) + cell_len(piece.rstrip()) > width:
            lines.append(line.rstrip())
            line = indent
        line += piece
        while cell_len(line.rstrip()) > width:  # one piece longer than the line
            end = max(1, next(n for n in range(len(line), -1, -1) if cell_len(line[:n]) <= width))
            lines.append(line[:end])
            line = indent + line[end:]
    return [*lines, line.rstrip()] if line.strip() else lines
