"""A stream that a function decodes: what a codec's library does not survive ends this process alone."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from numpy.typing import NDArray


def open_source(path: str) -> Stream:
    """The bytes of a file."""
    return Stream(Path(path).read_bytes())


class Stream:
    """Bytes of a stream."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def read(
        self, function: str, arguments: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """What ``module:function`` makes of the bytes: arrays by name."""
        module, name = function.split(":")
        return {}, getattr(import_module(module), name)(self._data, **arguments)
