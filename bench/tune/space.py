"""Which options are varied, and in what ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from econgs_bench.bench.store.records import Value
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.methods.interface import MethodSpec, Option, OptionValue
from econgs_bench.methods.options import CONFIGURATION, declared, resolve, written

REACH = 4.0
"""A number is searched from its smallest starting value / this to its largest starting value x this."""
_DIGITS = 3
"""Significant digits of values that are tried, so that a copied command line gives the same jobs."""
PUBLISHED = "paper"
"""Configuration of a method that the first trial has."""


class Stored(BaseModel):
    """What the file of a study is made of."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Range(Stored):
    """Values of an option that a study tries.

    Attributes:
        low, high: bounds of a number, inclusive.
        log: whether numbers are drawn on a logarithmic scale.
        whole: whether numbers are whole.
        choices: the only values, if not empty.
    """

    low: float = 0.0
    high: float = 0.0
    log: bool = False
    whole: bool = False
    choices: tuple[Value, ...] = ()

    @property
    def text(self) -> str:
        """The range, for people."""
        if self.choices:
            return ", ".join(map(written, self.choices))
        return f"{self.low:g} to {self.high:g}{' (log)' if self.log else ''}"

    def distribution(self) -> Any:
        """The range as Optuna knows it."""
        from optuna import distributions

        if self.choices:
            return distributions.CategoricalDistribution(self.choices)
        if self.whole:
            return distributions.IntDistribution(int(self.low), int(self.high), log=self.log)
        return distributions.FloatDistribution(self.low, self.high, log=self.log)

    def tidy(self, value: OptionValue) -> OptionValue:
        """A value of the range with few digits."""
        if self.choices or isinstance(value, str):
            return value
        return int(value) if self.whole else min(max(_rounded(value), self.low), self.high)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def range_of(option: Option, values: Sequence[OptionValue]) -> Range | None:
    """What a study tries of an option that starts at some values; None if that cannot be told.

    Choices are all tried. A number has the range that its declaration names (:attr:`Option.search`). Without
    one it has that of :data:`REACH` around its starting values, within its declared range, and a logarithmic
    scale where that spans more than a factor of :data:`REACH`. The declared range alone counts where no
    starting value is above 0.
    """
    if option.choices or isinstance(option.default, bool):
        return Range(choices=option.choices or (False, True))
    if isinstance(option.default, str):
        return None
    whole = isinstance(option.default, int)
    if option.search is not None:
        low, high = option.search
        return Range(low=low, high=high, log=0.0 < REACH * low < high, whole=whole)
    numbers = [float(value) for value in values]
    low, high = _rounded(min(numbers) / REACH), _rounded(max(numbers) * REACH)
    if min(numbers) < 0.0 or high == 0.0:
        if option.minimum is None or option.maximum is None:
            return None
        low, high = option.minimum, option.maximum
    low = max(low, option.minimum if option.minimum is not None else low)
    high = min(high, option.maximum if option.maximum is not None else high)
    if whole:
        low, high = math.ceil(low), math.floor(high)
    return Range(low=low, high=high, log=0.0 < REACH * low < high, whole=whole)


def starts(spec: MethodSpec, fixed: Mapping[str, OptionValue]) -> list[dict[str, OptionValue]]:
    """Overrides of the first trials: the published settings, where a method has them, and its own defaults.

    Args:
        spec: the method.
        fixed: options that every trial has.
    """
    if PUBLISHED not in spec.configurations or CONFIGURATION in fixed:
        return [dict(fixed)]
    return [{CONFIGURATION: PUBLISHED, **fixed}, dict(fixed)]


def search_space(
    spec: MethodSpec,
    preset: str,
    fixed: Mapping[str, OptionValue],
    names: Sequence[str] = (),
    swept: Sequence[str] = (),
) -> dict[str, Range]:
    """The options that a study varies, each with its range.

    Args:
        spec: the method.
        preset: whose defaults the ranges are around.
        fixed: options that every trial has; they are not varied.
        names: the options; default: :attr:`MethodSpec.tunable`, else all that declare choices or both bounds,
            and rate knobs that need a fit each.
        swept: rate knobs of which every trial has all values; they are not varied.

    Raises:
        UnknownName: the method has no such option.
        DataError: a named option cannot be varied, or the method has none that can.
    """
    declarations = declared(spec.options)
    values = [resolve(spec, preset, start).values for start in starts(spec, fixed)]
    ranges = {
        name: range_of(option, [each[name] for each in values]) for name, option in declarations.items()
    }
    for name in names:
        if name not in declarations:
            raise unknown("option", name, declarations, of=f"method {spec.name}")
        what = f"--option {name}"
        if name in fixed:
            raise DataError(what, "has one value in all trials (--set)", "Leave out one of the two")
        if name in swept:
            raise DataError(what, "every trial has all values of this rate knob", "Use --objective point")
        if ranges[name] is None:
            reason = "a text" if isinstance(declarations[name].default, str) else "0 without a maximum"
            remedy = f"Others: {', '.join(one for one in ranges if ranges[one] and one not in fixed)}"
            raise DataError(what, f"has no range: it is {reason}", remedy)
    bounded = [
        name
        for name, option in declarations.items()
        if option.choices
        or isinstance(option.default, bool)
        or (option.minimum is not None and option.maximum is not None)
    ]
    knobs = [knob.name for knob in spec.rate_knobs if knob.refit]
    chosen = {*(names or (*(spec.tunable or bounded), *knobs))} - {*fixed, *swept}
    space = {name: one for name, one in ranges.items() if name in chosen and one is not None}
    if not space:
        reason = "has no options to tune" + (" beside those of --set" if fixed else "")
        remedy = "Declare options with a minimum and a maximum, or choices, in its spec"
        raise DataError(f"method {spec.name!r}", reason, remedy)
    return space
