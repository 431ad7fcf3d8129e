"""The page of options, as ``python -m econgs_bench.methods.reference`` prints it and the site has it."""

from __future__ import annotations

from collections.abc import Iterator

from econgs_bench.methods.interface import MethodSpec, Option
from econgs_bench.methods.options import DRAWING, SAMPLES, declared, written
from econgs_bench.methods.registry import Registry

_HEAD = """# Options of the methods

`python -m econgs_bench.methods.reference` prints this page from the specs of the methods
(`methods/*/spec.py`). `--set METHOD.OPTION=VALUE` sets an option; it also sets `iterations`, the
budget, and `configuration`, a named set of options. Each section ends with what presets and
configurations change."""


def page() -> str:
    """The whole page, as Markdown: a table for each built-in method."""
    registry = Registry()
    sections = [part for name in registry.built_in() for part in _section(registry.spec(name))]
    return "\n\n".join([_HEAD, *sections]) + "\n"


def _section(spec: MethodSpec) -> Iterator[str]:
    yield f"## {spec.name}"
    options = declared(spec.options) | ({SAMPLES: DRAWING} if spec.point_sampled else {})
    rows = [
        f"| `{name}` | {written(option.default)} | {_values(option)} | {option.doc} |"
        for name, option in options.items()
    ]
    yield "\n".join(["| option | default | values | meaning |", "|---|---|---|---|", *rows])
    lines = [
        f"- preset `{name}`: {_settings({'iterations': count, **spec.presets.get(name, {})})}"
        for name, count in spec.iterations.items()
    ]
    for name, one in spec.configurations.items():
        budgets = {f"iterations of `{preset}`": count for preset, count in one.iterations.items()}
        if one.options or budgets:
            lines.append(f"- configuration `{name}`: {_settings({**one.options, **budgets})}")
    for knob in spec.rate_knobs:
        how = "one fit each" if knob.refit else "all from one fit"
        lines.append(f"- rates: {knob.name} = {', '.join(map(written, knob.values))} ({how})")
    if spec.tunable:
        lines.append(f"- `bench tune` varies: {', '.join(f'`{name}`' for name in spec.tunable)}")
    yield "\n".join(lines)


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


if __name__ == "__main__":
    print(page(), end="")
