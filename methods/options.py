"""Option values of a method: from a preset and ``--set method.option=value`` to one checked mapping."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.methods.interface import OPTION, MethodSpec, Option, OptionValue, V

ITERATIONS = "iterations"
"""Settable for every method like an option: the budget, which a preset otherwise gives."""

GROUP_BUDGET = "group_budget"
"""An option of this name of a method that trains scenes together: a group of n scenes has n to this power
times the iterations of one scene. Without such an option every group has those of one scene."""

SAMPLES = "samples"
"""Settable like an option where a method is point-sampled; :data:`DRAWING` declares it."""

DRAWING = Option(1, "rays a pixel when a model is drawn: a square, as 1, 4, 9, 16", 1, 1024)

DRAWN = "drawn"
"""Settable like an option where a program draws Gaussians that can be drawn here too: "own" or "here"."""

DRAWERS = Option("own", "who draws its Gaussians: its program, or this one", choices=("own", "here"))

_DRAWING_ALONE = (SAMPLES, DRAWN)
"""Settings that decide no fit."""

CONFIGURATION = "configuration"
"""Settable like an option where a method has configurations: the name of one."""

_TRUE = ("true", "yes", "on", "1")
_FALSE = ("false", "no", "off", "0")


@dataclass(frozen=True)
class Settings:
    """Everything that decides how a method is fitted, apart from scene and seed.

    Attributes:
        options: an instance of the spec's dataclass of options.
        iterations: training iterations of a group of one scene.
        overrides: options that differ from the preset's, with "iterations", "configuration", "samples" and
            "drawn".
        knob: the rate knob among them that needs a fit for each value; "" if there is none.
        samples: rays a pixel when the model is drawn; they decide no fit.
    """

    options: Any
    iterations: int
    overrides: dict[str, OptionValue]
    knob: str
    samples: int = 1

    @property
    def fitted(self) -> Settings:
        """The settings of the fit alone."""
        kept = {name: value for name, value in self.overrides.items() if name not in _DRAWING_ALONE}
        return replace(self, overrides=kept, samples=1)

    @property
    def drawing(self) -> dict[str, OptionValue]:
        """The settings of the drawing alone, where they differ from the usual ones."""
        return {name: self.overrides[name] for name in _DRAWING_ALONE if name in self.overrides}

    def budget(self, scenes: int, share: float = 1.0) -> int:
        """Training iterations of a group of that many scenes, or a share of them, at least one.

        See :data:`GROUP_BUDGET`.
        """
        whole = float(self.iterations * scenes ** getattr(self.options, GROUP_BUDGET, 0.0))
        return max(1, round(share * whole))

    @property
    def variant(self) -> str:
        """Label of the overrides."""
        return label(self.overrides)

    @property
    def values(self) -> dict[str, OptionValue]:
        """Name -> value of every option, as records hold them."""
        return asdict(self.options)


def label(overrides: Mapping[str, OptionValue]) -> str:
    """Overrides for people: "option=value" sorted and joined by commas; "" for the preset's own."""
    return ",".join(f"{name}={written(overrides[name])}" for name in sorted(overrides))


def declared(options: type[Any]) -> dict[str, Option]:
    """Name -> option of a dataclass of options, in the order of its fields.

    Raises:
        TypeError: it is no frozen dataclass, or a field is not declared by ``option`` or has a default of
            another type than its annotation.
    """
    return dict(_declared(cast(Any, options)))  # mypy takes type[Any] for unhashable


@cache  # tables resolve the settings of every fit
def _declared(options: Any) -> dict[str, Option]:
    parameters = getattr(options, "__dataclass_params__", None)
    if parameters is None or not parameters.frozen:
        raise TypeError(f"{options!r} is no frozen dataclass")
    types, result = get_type_hints(options), {}
    for one in fields(options):
        if OPTION not in one.metadata:
            raise TypeError(
                f"the field {one.name!r} is not declared by econgs_bench.methods.interface.option"
            )
        choices = get_args(types[one.name]) if get_origin(types[one.name]) is Literal else ()
        kind = type(choices[0]) if choices else types[one.name]
        if type(one.default) is not kind or kind not in _KINDS:
            raise TypeError(f"the default of {one.name!r}, {one.default!r}, is not of its type {kind!r}")
        result[one.name] = replace(one.metadata[OPTION], choices=choices)
    return result


def current(options: type[Any], values: Mapping[str, V]) -> dict[str, V]:
    """Values under today's names of their options (:attr:`.methods.interface.Option.formerly`)."""
    names = {one.formerly: name for name, one in declared(options).items() if one.formerly}
    return {names.get(name, name): value for name, value in values.items()}


def resolve(spec: MethodSpec, preset: str, overrides: Mapping[str, OptionValue] | None = None) -> Settings:
    """Defaults, overlaid by the preset, by the configuration, and by what the user set.

    Args:
        spec: the method.
        preset: one of the spec's presets.
        overrides: option (or "iterations", "configuration") -> value; strings are parsed by the option's
            type. Former names of options do as well.

    Raises:
        UnknownName: no such preset, configuration or option; near matches are listed.
        DataError: a value of the wrong type, out of range or not among the choices.
    """
    if preset not in spec.iterations:
        raise unknown("preset", preset, spec.iterations, of=f"method {spec.name}")
    declarations = declared(spec.options)
    options = {name: option.default for name, option in declarations.items()}
    options.update(spec.presets.get(preset, {}))
    iterations = spec.iterations[preset]
    changed: dict[str, OptionValue] = {}
    settings = current(spec.options, overrides or {})
    if spec.configurations and CONFIGURATION in settings:
        label = str(settings.pop(CONFIGURATION))
        if label not in spec.configurations:
            raise unknown("configuration", label, spec.configurations, of=f"method {spec.name}")
        configuration = spec.configurations[label]
        if configuration.options or configuration.iterations:
            changed[CONFIGURATION] = label
        options.update(configuration.options)
        iterations = configuration.iterations.get(preset, iterations)
    for name, text in settings.items():
        if name == ITERATIONS:
            value = check(spec.name, name, Option(iterations, "budget", minimum=1), text)
            if value != iterations:
                changed[name] = value
                iterations = int(value)
        elif name == SAMPLES and spec.point_sampled:
            samples = int(check(spec.name, name, DRAWING, text))
            if math.isqrt(samples) ** 2 != samples:
                near = f"{math.isqrt(samples) ** 2} or {(math.isqrt(samples) + 1) ** 2}"
                raise DataError(f"option {spec.name}.{name} = {samples}", "is no square", f"Take {near}, say")
            if samples != 1:
                changed[name] = samples
        elif name == DRAWN and spec.drawn_here:
            if check(spec.name, name, DRAWERS, text) != DRAWERS.default:
                changed[name] = text
        elif name in declarations:
            value = check(spec.name, name, declarations[name], text)
            if value != options[name]:
                changed[name] = value
                options[name] = value
        else:
            names = [*declarations, ITERATIONS, *([CONFIGURATION] if spec.configurations else [])]
            names += [SAMPLES] if spec.point_sampled else []
            names += [DRAWN] if spec.drawn_here else []
            raise unknown("option", name, names, of=f"method {spec.name}")
    knob = next((knob.name for knob in spec.rate_knobs if knob.refit and knob.name in changed), "")
    return Settings(spec.options(**options), iterations, changed, knob, int(changed.get(SAMPLES, 1)))


def parse_assignments(texts: Iterable[str]) -> dict[str, dict[str, OptionValue]]:
    """Split ``--set`` arguments "method.option=value" into method -> option -> text.

    Raises:
        DataError: not of that form, or one option set twice to different values.
    """
    parsed: dict[str, dict[str, OptionValue]] = {}
    for text in texts:
        target, equals, value = text.partition("=")
        method, dot, option = target.strip().rpartition(".")
        if not equals or not dot or not method or not option:
            raise DataError(
                f"--set {text}", "not of the form method.option=value", "Example: --set 3dgs.background=black"
            )
        options = parsed.setdefault(method, {})
        if options.setdefault(option, value.strip()) != value.strip():
            raise DataError(
                f"--set {text}", f"already set to {options[option]!r}", "Give each option one value"
            )
    return parsed


def check(method: str, name: str, option: Option, value: OptionValue) -> OptionValue:
    """One value, converted to the option's type.

    Raises:
        DataError: wrong type, out of range or not among the choices.
    """
    what = f"option {method}.{name} = {value!r}"
    remedy = f"{option.doc[:1].upper()}{option.doc[1:]}; default {written(option.default)}"
    converted = _convert(option.default, value)
    if converted is None:
        raise DataError(what, f"not {_KINDS[type(option.default)]}", remedy)
    if option.choices and converted not in option.choices:
        raise DataError(what, f"not one of {', '.join(written(c) for c in option.choices)}", remedy)
    if isinstance(converted, int | float) and not isinstance(converted, bool):
        if option.minimum is not None and converted < option.minimum:
            raise DataError(what, f"below the minimum {option.minimum:g}", remedy)
        if option.maximum is not None and converted > option.maximum:
            raise DataError(what, f"above the maximum {option.maximum:g}", remedy)
    return converted


BEYOND = 2**63
"""Whole numbers in records are smaller."""
_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text"}


def _convert(like: OptionValue, value: OptionValue) -> OptionValue | None:
    """``value`` in the type of ``like``, or None if it is not one."""
    if isinstance(like, str):
        return value if isinstance(value, str) else None
    if isinstance(like, bool):
        if isinstance(value, str):
            lowered = value.strip().lower()
            return True if lowered in _TRUE else False if lowered in _FALSE else None
        return value if isinstance(value, bool) else None
    if isinstance(value, bool):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):  # TOML has lists and dates too
        return None
    if not math.isfinite(number):
        return None
    if isinstance(like, float):
        return number
    return int(number) if number == int(number) and abs(number) < BEYOND else None


def written(value: OptionValue) -> str:
    """A value as people write it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else str(value)
