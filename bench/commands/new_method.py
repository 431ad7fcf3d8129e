"""``bench new-method``: the files of a method to begin with."""

from __future__ import annotations

import importlib.util
import keyword
import os
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from econgs_bench.bench.store.store import aside_of
from econgs_bench.datasets.errors import DataError


def new_method_arguments(parser: ArgumentParser) -> None:
    """What ``bench new-method`` takes."""
    parser.add_argument("name", metavar="NAME", help="its name: lower-case letters, digits, -")
    parser.add_argument(
        "--out", default=".", metavar="DIR", help="where its folder goes (default: the present folder)"
    )
    parser.add_argument(
        "--command", dest="commands", action="store_true",
        help="a method that other programs carry out: a TOML file with their commands, and small programs",
    )  # fmt: skip


def new_method(options: Namespace) -> int:
    """Write the folder of a new method and print what to do with it."""
    from econgs_bench.methods.skeleton import command_files, files

    name, package = options.name, options.name.replace("-", "_")
    folder = Path(options.out).expanduser().resolve() / package
    if folder.exists():
        raise DataError(folder, "exists already", "Choose another name, or another folder (--out)")
    _check(name, "" if options.commands else package)
    content = command_files(name) if options.commands else files(name, package)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with aside_of(folder) as aside:
        for path, text in content.items():
            (aside / path).parent.mkdir(parents=True, exist_ok=True)
            (aside / path).write_text(text, encoding="utf-8")
        os.rename(aside, folder)
    place = os.path.relpath(folder)
    place = str(folder) if place.startswith(os.pardir) else place
    where = "commands go into command.toml" if options.commands else f"code goes into {package}/method.py"
    print(f"{folder}: a method that trains. Its own {where}; then")
    print(f"  bench check-plugin {name} --plugins {place}")
    print(f"  bench run quick --method {name} --method 3dgs --plugins {place}")
    return 0


def _check(name: str, package: str) -> None:
    """Refuse names that are no names, and those that something else has.

    Args:
        name: of the method.
        package: of its code; "" if it has none.

    Raises:
        DataError: the reason.
    """
    from econgs_bench.methods.registry import Registry, check_name

    check_name(name, "bench new-method")
    if package and (not package.isidentifier() or keyword.iskeyword(package)):
        remedy = "Begin with a letter; - becomes _"
        raise DataError(f"method name {name!r}", f"{package!r} is no name of a Python package", remedy)
    registry = Registry()
    if name in registry.names() or name in registry.broken:
        raise DataError(f"method name {name!r}", "is the name of an installed method", "Choose another name")
    if package and (package in sys.modules or importlib.util.find_spec(package) is not None):
        reason = f"Python has a module {package!r} already"
        raise DataError(f"method name {name!r}", reason, "Choose another name")
