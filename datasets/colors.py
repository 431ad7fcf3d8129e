"""Colors as people write them."""

from __future__ import annotations

import re

REMEDY = 'Write a color as "#36f", "#3366ff" or three numbers from 0 to 1'


def hex_color(text: str) -> tuple[float, float, float]:
    """Red, green and blue in [0, 1] of ``#rgb`` or ``#rrggbb``.

    Raises:
        ValueError: the text is neither.
    """
    if not re.fullmatch(r"#([0-9a-fA-F]{3}|[0-9a-fA-F]{6})", text):
        raise ValueError(f"{text!r} is no color. {REMEDY}")
    digits = text[1:] if len(text) == 7 else "".join(2 * digit for digit in text[1:])
    red, green, blue = (int(digits[i : i + 2], 16) / 255.0 for i in (0, 2, 4))
    return red, green, blue
