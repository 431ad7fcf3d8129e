"""TOML files checked against a schema: an error names the file, the key and its line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from econgs_bench.datasets.errors import DataError

M = TypeVar("M")
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
"""Types of pydantic's error for a key that a model, or a dataclass, does not have."""


def read_toml(path: Path, schema: type[M], remedy: str, keys: Collection[str] = ()) -> M:
    """The content of a TOML file.

    Args:
        path: the file.
        schema: of its content: a class of pydantic, validated with the path as context.
        remedy: what to do about a file that is none.
        keys: known keys, of which the nearest is proposed for one that is unknown.

    Raises:
        DataError: the file cannot be read, is no TOML, or has an unusable key, which the reason names with
            its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
        table = tomllib.loads(text)
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "Name a readable file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(path, f"is no TOML file ({error})", remedy) from error
    except RecursionError as error:
        raise DataError(path, "is nested too deeply", remedy) from error
    try:
        return TypeAdapter(schema).validate_python(table, context={"path": path})
    except ValidationError as error:
        raise DataError(path, sentence(error, keys, text), remedy) from error


def sentence(error: ValidationError, keys: Collection[str] = (), text: str = "") -> str:
    """The first of what a schema refuses: the key, its line if it stands in a TOML text, and the reason.

    Args:
        error: of pydantic.
        keys: known keys, of which the nearest is proposed for one that is unknown.
        text: that was read.
    """
    # An unknown key first: what a misspelt key leaves missing would mislead.
    first, *others = sorted(error.errors(), key=lambda each: each["type"] not in _UNKNOWN)
    reason = first["msg"].removeprefix("Value error, ")
    if first["type"] in _UNKNOWN:
        near = get_close_matches(str(first["loc"][-1]), keys, n=1)
        reason = "unknown key" + "".join(f", perhaps {name}" for name in near)
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
    line = line_of(text, first["loc"])
    where = name.lstrip(".") + (f" (line {line})" if line else "")
    more = f" (and {len(others)} more)" if others else ""
    return f"{where}: {reason}{more}" if where else reason + more


def line_of(text: str, place: tuple[int | str, ...]) -> int:
    """Line of the deepest key of a place that is written in a TOML text, from 1; 0 if none is."""
    lines, found, start = text.splitlines(), 0, 0
    for key in (part for part in place if isinstance(part, str)):
        written = re.compile(rf"""(^|[\s\[.{{,])["']?{re.escape(key)}["']?\s*[=\].]""")
        for number in range(start, len(lines)):
            if written.search(lines[number].partition("#")[0]):
                found, start = number + 1, number
                break
    return found
