"""Stress as suites write it: harder conditions of a run, as ``noise=8`` or ``views=12 start=random``.

Each kind belongs to one part of a run: the truth (the scene itself), the training input, the fit, or the test
views. Jobs that a part does not decide are shared with runs without that stress.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from econgs_bench.bench.suites.edits import KINDS as EDITS
from econgs_bench.bench.suites.edits import edit_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown

Part = Literal["truth", "input", "fit", "test"]
PARTS: tuple[Part, ...] = ("truth", "input", "fit", "test")


@dataclass(frozen=True)
class StressKind:
    """A kind of stress.

    Attributes:
        part: of a run that it changes.
        doc: its value, for people.
        read: text -> value; raises ValueError.
    """

    part: Part
    doc: str
    read: Callable[[str], Any]


def _number(least: float, most: float = math.inf, *, whole: bool = False) -> Callable[[str], float]:
    def read(text: str) -> float:
        value = int(text) if whole else float(text)
        if not (least <= value <= most and math.isfinite(value)):
            raise ValueError
        return value

    return read


def _choice(*choices: str) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in choices:
            raise ValueError
        return text

    return read


def _edit(name: str) -> StressKind:
    def read(text: str) -> str:
        edit_of("scene", f"{name}={text}")
        return text

    return StressKind("truth", f"the scene after an edit of {name}", read)


KINDS: dict[str, StressKind] = {
    **{name: _edit(name) for name in EDITS},
    "views": StressKind("input", "number of training views, 2 or more, spread out", _number(2, whole=True)),
    "cameras": StressKind(
        "input", "training cameras of one `hemisphere` or one `ring`", _choice("hemisphere", "ring")
    ),
    "noise": StressKind(
        "input", "standard deviation of the training pictures' noise, in steps of 1/255", _number(0.0, 255.0)
    ),
    "poses": StressKind(
        "input", "error of the training cameras' directions, in degrees", _number(0.0, 180.0)
    ),
    "start": StressKind(
        "input", "initial cloud at `random`, or with a tenth of `outliers`", _choice("random", "outliers")
    ),
    "points": StressKind("input", "number of points of the initial cloud", _number(1, whole=True)),
    "units": StressKind("input", "factor on all coordinates that the method sees", _number(1e-6, 1e6)),
    "budget": StressKind("fit", "share of the iterations, above 0 and at most 1", _number(1e-6, 1.0)),
    "distance": StressKind(
        "test", "distance of the test cameras in units of the usual one, 0.01 to 100", _number(0.01, 100.0)
    ),
    "zoom": StressKind(
        "test", "factor on width and height of the test views, 0.01 to 8", _number(0.01, 8.0)
    ),
    "step": StressKind(
        "test",
        "degrees between test cameras, which are then neighbouring frames of a path, 0.01 to 10",
        _number(0.01, 10.0),
    ),
}  # fmt: skip


def stress_of(text: str) -> dict[str, Any]:
    """StressKind -> value, in the order of :data:`KINDS`; {} for "".

    Raises:
        DataError: a part is not of the form kind=value, its value cannot be read, or a kind is named twice.
        UnknownName: there is no such kind.
    """
    values: dict[str, Any] = {}
    for part in text.split():
        name, _, value = part.partition("=")
        if not value:
            raise DataError(f"stress {part!r}", "is not of the form kind=value", "Write noise=8")
        if name not in KINDS:
            raise unknown("stress", name, KINDS)
        if name in values:
            raise DataError(f"stress {text!r}", f"{name} is named twice", "Name it once")
        try:
            values[name] = KINDS[name].read(value)
        except ValueError:
            raise DataError(f"stress {part!r}", "its value is not possible", KINDS[name].doc) from None
    return {name: values[name] for name in KINDS if name in values}


def part_of(text: str, *parts: Part) -> str:
    """The kinds of some parts of a run alone, in one spelling; all parts by default.

    Raises:
        DataError, UnknownName: as :func:`stress_of`.
    """
    chosen = parts or PARTS
    return " ".join(
        f"{name}={value:g}" if isinstance(value, int | float) else f"{name}={value}"
        for name, value in stress_of(text).items()
        if KINDS[name].part in chosen
    )
