"""Serve one file: ``python -m econgs_bench.datasets.readers.child LIBRARY PATH BYTES``."""

from __future__ import annotations

import json
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import REFUSED, Slabs

_SECONDS = 3600
"""Processor time: what hangs when its parent has gone ends too."""


def main() -> None:
    """Serve the file named on the command line until stdin ends."""
    library, path, memory = sys.argv[1:]
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not mix with the answers
    try:
        module = import_module(f"econgs_bench.datasets.readers.child.{library}")
        _limit(int(memory))
        source = module.open_source(path)
        for line in sys.stdin:
            request = json.loads(line)
            if "list" in request:
                _answer(answers, source.contents() | {"arrays": []})
            else:
                about, parts = source.read(**request)
                _send(answers, about, parts, path)
    except DataError as error:
        _answer(answers, _said(error, path))
    except MemoryError:
        _answer(answers, {"error": f"needs more than {int(memory) >> 20} MiB of memory to be read"})
    except Exception as error:
        _answer(answers, {"error": f"cannot be read ({_text(error)})"})


def _limit(memory: int) -> None:
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            memory += int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, OSError, ValueError):
        pass  # not Linux


def _answer(answers: BinaryIO, answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer).encode() + b"\n")
    answers.flush()


def _text(error: Exception) -> str:
    """An error of a library in one bounded line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[-200:]}"


def _said(error: DataError, path: str) -> dict[str, str]:
    """An error as an answer; a file of a folder is named."""
    name = Path(error.what).name
    inside = Path(error.what).parent == Path(path) and name not in error.reason
    return {"error": f"its file {name} {error.reason}" if inside else error.reason, "remedy": error.remedy}


def _send(answers: BinaryIO, about: dict[str, Any], parts: dict[str, Any], path: str) -> None:
    arrays = []
    for name, part in parts.items():
        arrays.append({"name": name, "shape": part.shape, "dtype": part.dtype.str})
        if isinstance(part, Slabs) and part.offset is not None:
            arrays[-1]["offset"] = part.offset
    _answer(answers, about | {"arrays": arrays})
    try:
        for part in parts.values():
            for values in part.pieces if isinstance(part, Slabs) else [part]:
                answers.write(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
        answers.flush()
    except DataError as error:
        print(json.dumps(_said(error, path)), file=sys.stderr, flush=True)
        os._exit(REFUSED)
    except Exception as error:
        print(f"its values cannot be read ({_text(error)})", file=sys.stderr, flush=True)
        os._exit(3)  # without an error message among the values


if __name__ == "__main__":
    main()
