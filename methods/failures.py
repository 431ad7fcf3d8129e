"""Whose fault an exception is, and where in a plugin's code it came from."""

from __future__ import annotations

import errno
import importlib.util
import linecache
import sysconfig
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from econgs_bench import methods
from econgs_bench.methods.interface import MethodSpec

Fault = Literal["plugin", "harness", "machine"]
_HARNESS = [
    Path(methods.__path__[0]).resolve().parent / name
    for name in ("datasets", "econgs", "methods", "bench", "reports")
]
_PYTHON = [
    Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")
]
_SCARCE = {
    getattr(errno, name)
    for name in ("ENOSPC", "ENOMEM", "EDQUOT", "EMFILE", "ENFILE", "EIO", "EROFS")
    if hasattr(errno, name)
}
_FRAMES = 4


@dataclass(frozen=True)
class Failure:
    """An exception, as the author of a plugin wants to see it.

    Attributes:
        fault: whose it is: "plugin" if its code was running, "machine" if memory, disk or files ran out,
            else "harness".
        place: innermost line of the plugin's code, as "package/module.py:12"; "" if none was running.
        trace: the last lines of the plugin's code that led there, innermost last, and where the harness or a
            library raised; "" if none was running.
    """

    fault: Fault
    place: str = ""
    trace: str = ""


def failure(error: BaseException, spec: MethodSpec) -> Failure:
    """Where an exception, or one that caused it, left the code of a method."""
    home = _home(spec)
    for one in _chain(error):
        frames = list(traceback.extract_tb(one.__traceback__))
        own = [frame for frame in frames if _is_own(Path(frame.filename), home)]
        if own:
            machine = is_memory_error(one) or _is_scarce(one)
            return Failure("machine" if machine else "plugin", _place(own[-1], home), _trace(own, frames[-1]))
    machine = any(is_memory_error(one) or _is_scarce(one) for one in _chain(error))
    return Failure("machine" if machine else "harness")


def is_memory_error(error: BaseException) -> bool:
    """Whether an exception reports lack of memory, on the host or on a device."""
    if isinstance(error, MemoryError) or type(error).__name__ in ("OutOfMemoryError", "_ArrayMemoryError"):
        return True
    return isinstance(error, RuntimeError) and "not enough memory" in str(error)


def _is_scarce(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in _SCARCE


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An exception and those that it came from."""
    known: set[int] = set()
    one: BaseException | None = error
    while one is not None and id(one) not in known:
        known.add(id(one))
        yield one
        one = one.__cause__ or (None if one.__suppress_context__ else one.__context__)


def _home(spec: MethodSpec) -> Path | None:
    """The package of a method: folder, or file of a module alone; found without running it."""
    module = spec.implementation.partition(":")[0]
    parts = module.split(".")
    top = ".".join(parts[:3]) if module.startswith(f"{methods.__name__}.") else parts[0]
    try:
        found = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None
    if found is None or found.origin is None:
        return None
    origin = Path(found.origin).resolve()
    return origin.parent if found.submodule_search_locations else origin


def _is_own(file: Path, home: Path | None) -> bool:
    """Whether a file is the plugin's: in its package, or neither the harness's nor an installed library's."""
    if not file.is_file():  # <string>, <frozen importlib>
        return False
    file = file.resolve()
    if home is not None and file.is_relative_to(home):
        return True
    return not any(file.is_relative_to(folder) for folder in (*_HARNESS, *_PYTHON))


def _place(frame: traceback.FrameSummary, home: Path | None) -> str:
    file = Path(frame.filename).resolve()
    inside = home is not None and file.is_relative_to(home.parent)
    name = file.relative_to(home.parent).as_posix() if inside and home is not None else file.name
    return f"{name}:{frame.lineno}"


def _trace(own: list[traceback.FrameSummary], last: traceback.FrameSummary) -> str:
    lines = []
    for frame in own[-_FRAMES:]:
        lines.append(f"{frame.filename}:{frame.lineno}, in {frame.name}")
        lines.append(f"    {linecache.getline(frame.filename, frame.lineno or 0).strip()}")
    if last is not own[-1]:
        lines.append(f"raised in {last.filename}:{last.lineno}, in {last.name}")
    return "\n".join(lines)
