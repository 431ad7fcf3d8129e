"""Places of labels beside points, and widths of texts."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SIZE = 11.0
"""Size of a label's font in pixels."""
LINE = 13.0
"""Height of a label's line in pixels."""
FAR = 1.5 * LINE
"""A label that is further above or below its point has a line to it."""
_LIFTS = 24
"""Heights at which a label is tried."""
_WIDTHS = {
    0.222: "'ijl", 0.278: " !,./:;I[\\]ft|\N{MIDDLE DOT}", 0.333: "()-`r{}", 0.389: "*",
    0.5: "Jcksvxyz", 0.584: "+<=>~\N{MULTIPLICATION SIGN}", 0.611: "FTZ", 0.667: "&ABEKPSVXY",
    0.722: "CDHNRUw", 0.778: "GOQ", 0.833: "Mm", 0.889: "%", 0.944: "W", 1.0: "@\N{HORIZONTAL ELLIPSIS}",
}  # fmt: skip
_WIDTH = {letter: width for width, letters in _WIDTHS.items() for letter in letters}


def text_width(text: str, size: float = SIZE) -> float:
    """Width in pixels of a text in Helvetica or a font of its metrics (Arial, Liberation Sans)."""
    return size * sum(_WIDTH.get(letter, 0.556) for letter in text)


class Label(NamedTuple):
    """Where a label is.

    Attributes:
        x, y: of its anchor, the middle of its lines, in pixels, y down.
        anchor: "start", "end" or "middle" of its lines.
        lines: its text.
        box: left, top, right and bottom.
        far: whether it needs a line to its point.
    """

    x: float
    y: float
    anchor: str
    lines: tuple[str, ...]
    box: tuple[float, float, float, float]
    far: bool


def place_labels(
    points: Sequence[tuple[float, float]],
    texts: Sequence[str],
    area: tuple[float, float, float, float],
    *,
    avoid: Iterable[tuple[float, float]] = (),
) -> list[Label]:
    """Place labels beside their points without overlaps, greedily; those wider than half the area are broken.

    Args:
        points: positions in pixels, y down.
        texts: one per point.
        area: left, top, right and bottom that labels stay within.
        avoid: further points that no label should cover.
    """
    occupied = np.array([(x - 5, y - 5, x + 5, y + 5) for x, y in (*points, *avoid)])
    labels: list[Label] = []
    for (x, y), text in zip(points, texts, strict=True):
        most = int((area[2] - area[0]) / 2 / (text_width(text) / max(1, len(text))))
        lines = tuple(textwrap.wrap(text, most, break_long_words=False, break_on_hyphens=False))
        long, tall = max(map(text_width, lines)), LINE * len(lines)
        best: tuple[float, Label] | None = None
        for step in range(_LIFTS):
            lift = LINE * ((step + 1) // 2) * (-1 if step % 2 else 1)
            for anchor, dx, reach in (("start", 8.0, 0.0), ("end", -8.0, 1.0), ("middle", 0.0, 0.5)):
                if anchor == "middle" and step == 0:
                    continue
                left = x + dx - reach * long
                box = (left, y + lift - tall / 2, left + long, y + lift + tall / 2)
                outside = sum(
                    max(0.0, excess)
                    for excess in (area[0] - box[0], area[1] - box[1], box[2] - area[2], box[3] - area[3])
                )
                cost = 3000.0 * outside + abs(lift)
                if best is not None and cost >= best[0]:
                    continue
                cost += 100.0 * float(overlap(box, occupied).sum())
                if best is None or cost < best[0]:
                    best = cost, Label(x + dx, y + lift, anchor, lines, box, abs(lift) > FAR)
        assert best is not None
        labels.append(best[1])
        occupied = np.vstack([occupied, best[1].box])
    return labels


def overlap(box: tuple[float, float, float, float], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) areas that a box shares with (n, 4) others, in square pixels."""
    wide = np.minimum(box[2], others[:, 2]) - np.maximum(box[0], others[:, 0])
    tall = np.minimum(box[3], others[:, 3]) - np.maximum(box[1], others[:, 1])
    areas: NDArray[np.float64] = np.maximum(wide, 0.0) * np.maximum(tall, 0.0)
    return areas
