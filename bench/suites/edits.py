"""Edits as the command line writes them: ``a.palette=#ff8800``, ``a.opacity=0.5``, ``a.light=1,0,0``."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import cycle
from pathlib import Path
from typing import Any

from econgs_bench.datasets.colors import hex_color
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.toml import read_toml

KINDS = tuple(field.name for field in fields(Edit) if field.name != "transfer")
"""Edits that a text can write; a transfer function is none of them."""


def parse_edits(texts: Iterable[str]) -> dict[str, Edit]:
    """Scene -> its edit.

    Raises:
        DataError: a text is not of the form scene.what=value, or its value cannot be read.
        UnknownName: there is no such edit.
    """
    edits: dict[str, Edit] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        scene, dot, kind = key.rpartition(".")
        if not (equals and dot and scene and value):
            raise DataError(f"--edit {text}", "is not of the form scene.what=value", "Write skin.opacity=0.5")
        if kind not in KINDS:
            raise unknown("edit", kind, KINDS)
        edits[scene] = replace(edits.get(scene, Edit()), **{kind: _value(text, kind, value)})
    return edits


def toml_of(edits: Mapping[str, Edit]) -> str:
    """The file of edits that :func:`given_edits` reads: a table per scene, values as on the command line."""
    lines = ["# bench render DATASET --model JOB --edit THIS_FILE"]
    for scene, edit in edits.items():
        pairs = [part.split("=", 1) for part in text_of(edit).split()]
        name = json.dumps(scene, ensure_ascii=False).replace("\x7f", "\\u007f")  # a basic string of TOML
        lines += ["", f"[{name}]", *(f'{kind} = "{value}"' for kind, value in pairs)]
    return "\n".join(lines) + "\n"


def given_edits(words: Iterable[str]) -> dict[str, Edit]:
    """Edits of a command line, where a word may name a file that :func:`toml_of` wrote.

    Raises:
        DataError: a file cannot be read, or is no file of edits; and as :func:`parse_edits`.
    """
    texts: list[str] = []
    for word in words:
        if "=" in word or not word.lower().endswith(".toml"):
            texts.append(word)
            continue
        remedy = 'Write [skin] and below it opacity = "0.5"'
        tables = read_toml(Path(word), dict[str, dict[str, str | int | float]], remedy)
        texts += [f"{scene}.{kind}={value}" for scene, edit in tables.items() for kind, value in edit.items()]
    return parse_edits(texts)


def edit_of(scene: str, text: str) -> dict[str, Edit]:
    """The edit of one scene in the form of suites and jobs: "opacity=0.5 light=1,0,0"; {} for "".

    Raises:
        DataError, UnknownName: as :func:`parse_edits`.
    """
    return parse_edits(f"{scene}.{part}" for part in text.split())


def edits_of(scenes: Sequence[str], text: str) -> dict[str, Edit]:
    """Scene -> its edit, for a text like "opacity=0.5 | palette=#ff8800 | light=1,0,0".

    The first part is for the first scene, the second for the second, and after the last one the first again.

    Raises:
        DataError, UnknownName: as :func:`parse_edits`.
    """
    parts = text.split("|")
    edits: dict[str, Edit] = {}
    for scene, part in zip(scenes, cycle(parts), strict=False):
        edits |= edit_of(scene, part)
    return edits


def text_of(edit: Edit) -> str:
    """An edit in the form that :func:`edit_of` reads: colors of 8 bits, numbers of four digits."""
    values = ((kind, getattr(edit, kind)) for kind in KINDS)
    return " ".join(f"{kind}={_text(kind, value)}" for kind, value in values if value is not None)


def _text(kind: str, value: Any) -> str:
    if kind == "palette":
        return "#" + "".join(f"{round(255 * channel):02x}" for channel in value)
    if isinstance(value, tuple):
        return ",".join(f"{number:.4g}" for number in value)
    return value if isinstance(value, str) else f"{value:.4g}"


def _value(text: str, kind: str, value: str) -> Any:
    if kind == "palette":
        try:
            return hex_color(value)
        except ValueError as error:
            raise DataError(f"--edit {text}", f"{value!r} is no color", "Write it as #ff8800") from error
    if kind == "light" and value == "headlight":
        return value
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    length = math.hypot(*numbers)
    if kind == "light":
        if len(numbers) != 3 or not 0.0 < length < math.inf:
            raise DataError(f"--edit {text}", f"{value!r} is no direction", "Write headlight, or x,y,z")
        return tuple(number / length for number in numbers)
    if kind == "shift":
        if len(numbers) != 1 or not math.isfinite(numbers[0]):
            raise DataError(f"--edit {text}", f"{value!r} is no number of widths", "Write 0.5 or -0.5")
        return numbers[0]
    if kind == "width" and numbers[:1] == [0.0]:
        raise DataError(f"--edit {text}", "a bump of no width shows nothing", "Give a number above 0")
    if len(numbers) != 1 or not math.isfinite(numbers[0]) or numbers[0] < 0.0:
        raise DataError(f"--edit {text}", f"{value!r} is no factor", "Give a number of at least 0")
    return numbers[0]
