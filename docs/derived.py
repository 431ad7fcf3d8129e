"""Pages of the site that follow from the code; they are written when it is built, and git ignores them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable

import econgs_bench
from econgs_bench.bench.__main__ import parser
from econgs_bench.datasets.catalogue import DatasetInfo, list_datasets
from econgs_bench.methods import reference as methods
from econgs_bench.reports import reference as tables


def command_line() -> str:
    """Every command of ``bench`` with its arguments and options, as Markdown."""
    program = parser()
    (commands,) = (action for action in program._actions if isinstance(action, argparse._SubParsersAction))
    text = "# Command line\n\n`bench COMMAND`, or `python -m econgs_bench.bench COMMAND`. Every command has "
    text += f"`--help`, and `--debug` for tracebacks of errors in the input.\n\n{program.epilog}\n"
    for name, command in commands.choices.items():
        purpose = _help(command.description)
        text += f"\n## bench {name}\n\n{purpose[:1].upper()}{purpose[1:]}.\n\n|argument|meaning|\n|---|---|\n"
        for action in command._actions:
            if action.dest not in ("help", "debug"):
                text += f"|{_argument(action)}|{_help(action.help)}|\n"
    return text


def _argument(action: argparse.Action) -> str:
    what = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    what = str(what).replace("|", "\\|")
    if not action.option_strings:
        return f"`{what}…`" if action.nargs in ("*", "+") else f"`{what}`"
    takes = "" if action.nargs == 0 else f" {what}"
    return f"`{action.option_strings[-1]}{takes}`"


def _help(text: str | None) -> str:
    return (text or "").replace("%%", "%").replace("|", "\\|")


def procedural() -> str:
    """The volumes that are made by formulas, and the sets that they stand in for, as Markdown."""
    text = (
        "# Procedural volumes\n\nVolumes made from formulas: deterministic by seed, the same field at any "
        "resolution (`ship_wake@256`: samples along the longest side). A **stand-in** resembles a set of the "
        "paper in proportions, variables and number of scenes; it is not that set, and its numbers do not "
        "compare with the paper's. `bench render --contact-sheet NAME` draws the scenes.\n"
    )
    infos = list_datasets([])
    text += _datasets("Formulas", [one for one in infos if one.kind == "procedural"])
    return text + _datasets(
        "Other entries of the catalogue", [one for one in infos if one.kind != "procedural"]
    )


def _datasets(title: str, infos: Iterable[DatasetInfo]) -> str:
    text = f"\n## {title}\n\n|name|samples|scenes|content|\n|---|---|---|---|\n"
    for info in infos:
        size = "\N{MULTIPLICATION SIGN}".join(map(str, info.dims or ()))
        text += f"|`{info.name}`|{size}|{', '.join(info.scenes)}|{info.title}|\n"
    return text


def python() -> str:
    """The Python interface, as directives of autodoc."""
    text = "# Python interface\n\n`import econgs_bench` has these names. "
    text += "[The notebook](../guide/python.ipynb) shows them.\n"
    for name in econgs_bench.__all__:
        kind = "class" if isinstance(getattr(econgs_bench, name), type) else "function"
        members = "   :members:\n" if kind == "class" else ""
        text += f"\n## {name}\n\n```{{eval-rst}}\n.. auto{kind}:: econgs_bench.{name}\n{members}```\n"
    return text


PAGES: dict[str, Callable[[], str]] = {
    "command-line.md": command_line,
    "options.md": methods.page,
    "tables.md": tables.page,
    "procedural.md": procedural,
    "python.md": python,
}
"""File in ``docs/reference`` -> its content."""
