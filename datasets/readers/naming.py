"""Names of fields on a command line: ``PATH:variable=T,step=3,resolution=256``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from datasets.errors import DataError
from datasets.names import unknown

KEYS = ("variable", "step", "resolution")

_CHOICES = re.compile(r"(.+?):((?:[A-Za-z_]+=).*)", re.DOTALL)


@dataclass(frozen=True)
class FileName:
    """A file and a choice in it; None stands for the default.

    Attributes:
        path: the file.
        variable: name in the file.
        step: time step, from 0.
        resolution: samples along the longest side, for meshes only.
    """

    path: Path
    variable: str | None = None
    step: int | None = None
    resolution: int | None = None

    @staticmethod
    def parse(text: str) -> FileName:
        """The parts of a name; an existing file of exactly that name has no further parts.

        Raises:
            UnknownName: an unknown key; the remedy lists near matches.
            DataError: a key occurs twice or without value, or a number is malformed.
        """
        path, choices = split(text)
        if not choices:
            return FileName(path)
        values: dict[str, str] = {}
        for part in re.split(r",(?=[A-Za-z_]+=)", choices):  # names may hold commas
            key, _, value = part.partition("=")
            if key not in KEYS:
                raise unknown("key", key, KEYS, of=text)
            if key in values or not value:
                raise DataError(text, f"{key} is given twice or empty", f"Write {path}:{key}=... once")
            values[key] = value
        numbers: dict[str, int] = {}
        for key in ("step", "resolution"):
            if key in values and not re.fullmatch(r"[0-9]{1,9}", values[key]):
                raise DataError(text, f"{key} {values[key]!r} is no number", f"Write {key}=3, say")
            if key in values:
                numbers[key] = int(values[key])
        return FileName(path, values.get("variable"), **numbers)


def split(text: str) -> tuple[Path, str]:
    """The path, and the text after its colon (else ""), unchecked."""
    match = _CHOICES.fullmatch(text)
    try:
        if match is None or Path(text).expanduser().exists():
            return Path(text).expanduser(), ""
    except (OSError, ValueError):
        return Path(text), ""
    return Path(match[1]).expanduser(), match[2]
