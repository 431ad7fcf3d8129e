"""Options of the methods: a page of the site, and what ``bench list methods NAME`` prints."""

from __future__ import annotations

from collections.abc import Iterator

from econgs_bench.methods.interface import MethodSpec, Option
from econgs_bench.methods.options import DRAWING, SAMPLES, declared, written
from econgs_bench.methods.registry import Registry

_HEAD = """# Options of the methods

`bench list methods NAME` prints a section, of your own methods too. `--set METHOD.OPTION=VALUE` sets
an option; it also sets `iterations`, the budget, and `configuration`, a named set of options. Each
section ends with what presets and configurations change."""


def page() -> str:
    """The whole page, as Markdown: a table for each built-in method."""
    registry = Registry()
    sections = [part for name in registry.built_in() for part in _section(registry.spec(name))]
    return "\n\n".join([_HEAD, *sections]) + "\n"


def options_of(spec: MethodSpec) -> list[tuple[str, str, str, str]]:
    """Name, default, values and meaning of each option of a method."""
    options = declared(spec.options) | ({SAMPLES: DRAWING} if spec.point_sampled else {})
    return [(name, written(one.default), _values(one), one.doc) for name, one in options.items()]


def settings_of(spec: MethodSpec) -> Iterator[tuple[str, str]]:
    """What a method has of presets, configurations, rates and search, and the values, as Markdown."""
    for name, count in spec.iterations.items():
        yield f"preset `{name}`", _settings({"iterations": count, **spec.presets.get(name, {})})
    for name, one in spec.configurations.items():
        budgets = {f"iterations of `{preset}`": count for preset, count in one.iterations.items()}
        if one.options or budgets:
            yield f"configuration `{name}`", _settings({**one.options, **budgets})
    for knob in spec.rate_knobs:
        how = "one fit each" if knob.refit else "all from one fit"
        yield "rates", f"{knob.name} = {', '.join(map(written, knob.values))} ({how})"
    if spec.tunable:
        yield "searched by `bench tune`", ", ".join(f"`{name}`" for name in spec.tunable)


def _section(spec: MethodSpec) -> Iterator[str]:
    yield f"## {spec.name}"
    rows = [f"| `{name}` | {default} | {values} | {doc} |" for name, default, values, doc in options_of(spec)]
    yield "\n".join(["| option | default | values | meaning |", "|---|---|---|---|", *rows])
    yield "\n".join(f"- {what}: {text}" for what, text in settings_of(spec))


def _values(option: Option) -> str:
    if option.choices:
        return ", ".join(map(written, option.choices))
    if isinstance(option.default, bool):
        return "true, false"
    if isinstance(option.default, str):
        return "text"
    low, high = (None if bound is None else written(bound) for bound in (option.minimum, option.maximum))
    if low is not None and high is not None:
        return f"{low} to {high}"
    return f"≥ {low}" if low is not None else f"≤ {high}" if high is not None else "any"


def _settings(values: dict[str, bool | int | float | str]) -> str:
    return ", ".join(f"{name} = {written(value)}" for name, value in values.items())
