"""Text of any origin as the data of a terminal, of XML, of Markdown and of CSV: never as their commands.

A label may come from a stranger's bundle. Each writer asks the function of its format, here alone.
"""

from __future__ import annotations

import hashlib
import re

_LINE = re.compile("[^ -~]")
"""What may not be printed: all beside printable ASCII."""
_BLOCK = re.compile("[^\n\t -~]")
_NAME = 130
"""Systems have names of 255 bytes, and some 143."""
_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What no document of XML 1.0 holds, not even as a reference (section 2.2)."""
_MARKDOWN = re.compile(
    r"""[\\|*]              # escapes, cells, emphasis
    | (?<=\])[(\[]          # the target of a link or of a picture
    | ~(?=~)                # struck out
    | (?<![^\W_])_ | _(?![^\W_])  # emphasis; within a word it is a letter
    """,
    re.VERBOSE,
)
_NUMBER = r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_FORMULA = re.compile(rf"(?!{_NUMBER}(?: to {_NUMBER})?$)'*[=+\-@\t\r]")
"""A number, or a range of two, is none."""


def printable(text: str) -> str:
    """A text with escapes in the place of all that is not printed, line breaks and tabs aside."""
    return _BLOCK.sub(_escaped, text)


def one_line(text: str) -> str:
    """:func:`printable`, with escapes in the place of line breaks and tabs too."""
    return _LINE.sub(_escaped, text)


def _escaped(sign: re.Match[str]) -> str:
    return sign[0] if sign[0].isprintable() else sign[0].encode("unicode_escape").decode("ascii")


def short_name(text: str) -> str:
    """A file's name of at most 130 bytes, without its suffix: a longer one is cut and ends in a hash."""
    data = text.encode("utf-8")
    if len(data) <= _NAME:
        return text
    return f"{data[: _NAME - 17].decode('utf-8', 'ignore')}-{hashlib.sha256(data).hexdigest()[:16]}"


def xml_text(text: str) -> str:
    """A text, or a whole document, with escapes in the place of signs that XML 1.0 forbids."""
    return _XML.sub(_escaped, text)


def markdown_cell(text: str) -> str:
    """A text as it is read in a cell, a line or a heading of Markdown: no markup, no HTML, no line break.

    Pairs of backticks stay: messages name commands in them, and code has no effect.
    """
    plain = one_line(re.sub(r"\s*[\r\n]+\s*", " ", text))
    if plain.count("`") % 2:
        plain = plain.replace("`", "'")
    plain = _MARKDOWN.sub(lambda sign: "\\" + sign[0], plain)
    return re.sub(r"&(?=#?\w+;)", "&amp;", plain).replace("<", "&lt;")


def csv_cell(text: str) -> str:
    """A text that no spreadsheet takes for a formula: a quote precedes what would begin one.

    :func:`csv_text` is the inverse.
    """
    return f"'{text}" if _FORMULA.match(text) else text


def csv_text(cell: str) -> str:
    """The text of a :func:`csv_cell`."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
