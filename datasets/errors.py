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


class UnknownName(DataError):
    """A name outside its list; the remedy holds near matches."""
