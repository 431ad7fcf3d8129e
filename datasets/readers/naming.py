"""Names of fields on a command line: ``PATH:variable=T,step=3,range=0,100,missing=-999``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown

KEYS = ("variable", "step", "resolution", "range", "missing")

_CHOICES = re.compile(r"(.+?):((?:[A-Za-z_]+=).*)", re.DOTALL)


@dataclass(frozen=True)
class FileName:
    """A file and a choice in it; None stands for the default.

    Attributes:
        path: the file.
        variable: name in the file.
        step: time step, from 0.
        resolution: samples along the longest side, for meshes only.
        value_range, missing: which values are shown (:class:`.datasets.readers.limits.Limits`).
    """

    path: Path
    variable: str | None = None
    step: int | None = None
    resolution: int | None = None
    value_range: tuple[float, float] | Literal["all"] | None = None
    missing: tuple[float, ...] = ()

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
        shown = parse_range(values["range"]) if "range" in values else None
        missing = parse_numbers("missing", values["missing"]) if "missing" in values else ()
        return FileName(path, values.get("variable"), **numbers, value_range=shown, missing=missing)


def parse_range(text: str) -> tuple[float, float] | Literal["all"]:
    """A range as it is written: "LOW,HIGH" or "all".

    Raises:
        DataError: it is neither, or does not ascend.
    """
    if text.strip() == "all":
        return "all"
    ends = parse_numbers("range", text)
    if len(ends) != 2 or not (ends[0] < ends[1] and math.isfinite(ends[1] - ends[0])):
        raise DataError(f"range {text}", "is no range of values", "Write two numbers, LOW,HIGH, or all")
    return ends[0], ends[1]


def parse_numbers(key: str, text: str) -> tuple[float, ...]:
    """Numbers between commas; nan and inf are numbers too.

    Raises:
        DataError: a part is no number.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise DataError(f"{key} {text}", "is no list of numbers", f"Write {key}=-999, say") from error


def split(text: str) -> tuple[Path, str]:
    """The path, and the text after its colon (else ""), unchecked."""
    match = _CHOICES.fullmatch(text)
    try:
        if match is None or Path(text).expanduser().exists():
            return Path(text).expanduser(), ""
    except (OSError, ValueError):
        return Path(text), ""
    return Path(match[1]).expanduser(), match[2]
