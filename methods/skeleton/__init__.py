"""A complete small method outside of the harness: what ``bench new-method`` writes, under another name."""

from __future__ import annotations

import re
from pathlib import Path

NAME, PACKAGE = "toy-blobs", "toy_blobs"
"""Names of the method and of its package in the files beside this one; :func:`files` replaces both."""


def files(name: str, package: str) -> dict[str, str]:
    """The files of a new method: path in its folder -> content.

    Args:
        name: the method's name, as on the command line.
        package: name of its Python package.
    """
    folder = Path(__file__).parent
    paths = [*folder.glob("*.toml"), *folder.glob("*.md"), *folder.glob("test_*.py"), *folder.glob("*/*.py")]
    names = {NAME: name, PACKAGE: package}

    def renamed(text: str) -> str:
        return re.sub("|".join(names), lambda match: names[match[0]], text)

    return {
        renamed(path.relative_to(folder).as_posix()): renamed(path.read_text(encoding="utf-8"))
        for path in sorted(paths)
    }


def command_files(name: str) -> dict[str, str]:
    """The files of a new method of commands: file name -> content.

    Args:
        name: the method's name, as on the command line.
    """
    folder = Path(__file__).parents[1] / "command" / "skeleton"
    paths = [*folder.glob("*.toml"), *(path for path in folder.glob("*.py") if path.stem != "__init__")]
    return {path.name: path.read_text(encoding="utf-8").replace("toy-commands", name) for path in paths}
