"""HDF5 files (NetCDF-4 too), read by a separate process (:mod:`datasets.readers.hdf5_child`).

This process maps contiguous arrays into memory; others arrive through a pipe.
"""

from __future__ import annotations

import json
import math
import select
import subprocess
import sys
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.container import Array
from datasets.readers.fields import need

_PATIENCE = 60.0
"""Seconds without an answer until a file counts as damaged."""
_REMEDY = "Copy it again, or write it again with h5py or netCDF4"


class Hdf5:
    """An open HDF5 file: its arrays by name (with their groups)."""

    def __init__(self, path: Path) -> None:
        need("h5py", path)
        self.path = path
        child = Path(__file__).with_name("hdf5_child.py")
        self._child = subprocess.Popen(
            [sys.executable, "-P", str(child), str(path.resolve())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        )
        weakref.finalize(self, _end, self._child)
        self.arrays: dict[str, Array] = {}
        for answer in self._ask({"list": True})["arrays"]:
            attributes = answer["attributes"]
            shape, dtype = tuple(answer["shape"]), np.dtype(answer["dtype"])
            if "no positions" not in attributes:
                self.arrays[answer["name"]] = Array(
                    answer["name"], shape, dtype, tuple(answer["dims"]), attributes
                )

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension."""
        answer = self._ask({"read": name, "first": first})
        shape, dtype = tuple(answer["shape"]), np.dtype(answer["dtype"])
        size = math.prod(shape) * dtype.itemsize
        if size == 0:
            return np.empty(shape, dtype)
        if "offset" in answer:
            if answer["offset"] + size > self.path.stat().st_size:
                raise DataError(self.path, f"is truncated: {name!r} ends beyond its end", "Copy it again")
            return np.memmap(self.path, dtype, mode="r", offset=answer["offset"], shape=shape)
        values: NDArray[Any] = np.empty(size, np.uint8)
        view, fill = values.data, 0
        while fill < size:
            fill += self._wait_into(view[fill:])
        return np.asarray(values.view(dtype).reshape(shape))

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._child.stdin is not None
        with suppress(BrokenPipeError):  # its answer holds the reason, unless it crashed
            self._child.stdin.write(json.dumps(request).encode() + b"\n")
        line = bytearray()
        byte = memoryview(bytearray(1))
        while not line.endswith(b"\n"):
            self._wait_into(byte)
            line += byte
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise DataError(self.path, f"cannot be read as HDF5 ({answer['error']})", _REMEDY)
        return answer

    def _wait_into(self, view: memoryview) -> int:
        """Read the bytes that have arrived, at least one."""
        pipe = self._child.stdout
        assert pipe is not None
        if not select.select([pipe], [], [], _PATIENCE)[0]:
            _end(self._child)
            raise DataError(self.path, f"is damaged: reading it stood still for {_PATIENCE:.0f} s", _REMEDY)
        read = pipe.readinto(view)  # type: ignore[attr-defined]
        if not read:
            code = self._child.wait()
            why = "its values cannot be read" if code == 3 else f"HDF5's library ended with code {code}"
            raise DataError(self.path, f"is damaged: {why}", _REMEDY)
        return int(read)


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()
    for pipe in (child.stdin, child.stdout):
        if pipe is not None:
            pipe.close()
