"""Errors that name the object, the reason and the remedy."""

from __future__ import annotations

from os import PathLike, fspath


class DataError(Exception):
    """Unusable input: names the file (or object), the reason and the remedy.

    The command line prints ``str(error)`` and no traceback (unless ``--debug``).

    Args:
        what: the file or object at fault.
        reason: what is wrong with it.
        remedy: what the user can do about it.
    """

    def __init__(self, what: str | PathLike[str], reason: str, remedy: str) -> None:
        self.what = fspath(what)
        self.reason = reason
        self.remedy = remedy
        super().__init__(self.what, reason, remedy)

    def __str__(self) -> str:
        return f"{self.what}: {self.reason}. {self.remedy}"


def text_of(error: BaseException) -> str:
    """The text of an exception of foreign code: one line that no terminal takes for a command."""
    try:
        text = str(error)
    except Exception:
        text = "an exception without text"
    line = next(iter(text.strip().splitlines()), "")
    return printable(line)


def printable(text: str) -> str:
    """A text with escapes in the place of all that is not printed, line breaks and tabs aside."""
    return "".join(
        one if one.isprintable() or one in "\n\t" else one.encode("unicode_escape").decode() for one in text
    )


class UnknownName(DataError):
    """A name outside its list; the remedy holds near matches."""
