"""How one field of a file is named on a command line: ``PATH:variable=T,step=3,resolution=256``."""

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
    """A file and what is wanted of it; None where nothing is said.

    Attributes:
        path: the file.
        variable: name in the file.
        step: time step, from 0.
        resolution: meshes only: samples along the longest side.
    """

    path: Path
    variable: str | None = None
    step: int | None = None
    resolution: int | None = None

    @staticmethod
    def parse(text: str) -> FileName:
        """The parts of a name; a file of exactly that name is taken as it is.

        Raises:
            UnknownName: an unknown key; near matches are listed.
            DataError: a key twice, without value, or a number that is none.
        """
        path, choices = split(text)
        if not choices:
            return FileName(path)
        said: dict[str, str] = {}
        for part in re.split(r",(?=[A-Za-z_]+=)", choices):  # names may hold commas
            key, _, value = part.partition("=")
            if key not in KEYS:
                raise unknown("key", key, KEYS, of=text)
            if key in said or not value:
                raise DataError(text, f"{key} is given twice or empty", f"Write {path}:{key}=... once")
            said[key] = value
        numbers: dict[str, int] = {}
        for key in ("step", "resolution"):
            if key in said and not re.fullmatch(r"[0-9]{1,9}", said[key]):
                raise DataError(text, f"{key} {said[key]!r} is no number", f"Write {key}=3, say")
            if key in said:
                numbers[key] = int(said[key])
        return FileName(path, said.get("variable"), **numbers)


def split(text: str) -> tuple[Path, str]:
    """The path, and what follows its colon ("" if nothing does); not checked."""
    match = _CHOICES.fullmatch(text)
    try:
        if match is None or Path(text).expanduser().exists():
            return Path(text).expanduser(), ""
    except (OSError, ValueError):
        return Path(text), ""
    return Path(match[1]).expanduser(), match[2]
