"""Files that other people's libraries read, in a separate process (:mod:`.datasets.readers.child`).

A damaged file can make such a library crash, hang, allocate without bound or end its process. Here each of
these becomes a :class:`~.datasets.errors.DataError`, and so does any text that the library writes on stderr.
"""

from __future__ import annotations

import fcntl
import json
import math
import re
import select
import signal
import subprocess
import sys
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import REFUSED
from econgs_bench.datasets.readers.container import Array
from econgs_bench.datasets.readers.fields import Choice, Field, Variable, scalar
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.scratch import new_array

PATIENCE = 60.0
"""Seconds without an answer until a file counts as damaged; more for large files."""
_RATE = 10e6  # bytes per second, slower than any reader here
_MEMORY = 4 << 30
_MESSAGE = 300

_HARMLESS = ("(Unknown Attribute Type None)",)
"""Lines on stderr that say nothing of the file: VTK's XDMF reader prints this for its own writer's files."""

_WARNINGS = ("WARN|", "WARNING: In ")
"""Marks of VTK's and ITK's warnings, which do not end a reading."""
_LOST = "missing slices"
"""What ITK warns of although values are missing."""


class Sandbox:
    """A process that has opened one file with one library.

    Args:
        path: file or folder.
        library: module of :mod:`.datasets.readers.child`.
        needed: bytes that its answers take.
    """

    def __init__(self, path: Path, library: str, needed: int = 0) -> None:
        self.path, self._library = path, library
        self._warned = False
        size = _size(path) + needed // 4
        self._patience = PATIENCE + (size + needed) / _RATE
        options = [library, str(path.resolve()), str(_memory(size))]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (closed by _end)
        self._child = _start(options, self._stderr)
        if hasattr(fcntl, "F_SETPIPE_SZ"):  # Linux: nearly twice as fast as with its default of 64 KiB
            with suppress(OSError):
                fcntl.fcntl(self._child.stdout, fcntl.F_SETPIPE_SZ, 1 << 20)  # type: ignore[arg-type]
        weakref.finalize(self, _end, self._child, self._stderr)

    def ask(self, **request: Any) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """An answer: its JSON values, and its arrays.

        Raises:
            DataError: the library fails, complains, crashes or stands still.
        """
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
            complaint = self._complaint()
            reason = answer["error"] + (f": {complaint}" if complaint else "")
            raise DataError(self.path, reason, answer.get("remedy", self._remedy))
        arrays = {part["name"]: self._receive(part) for part in answer.pop("arrays")}
        complaint, warned = self._complaint(), self._warned
        if complaint and not warned:
            raise DataError(self.path, f"is damaged or unreadable: {complaint}", self._remedy)
        for text in dict.fromkeys(filter(None, (answer.get("notice"), complaint))):
            notice(f"{self.path}: {text}")
        return answer, arrays

    @property
    def _remedy(self) -> str:
        return f"Copy it again, or write it again with {_WRITERS[self._library]}"

    def _receive(self, part: dict[str, Any]) -> NDArray[Any]:
        shape, dtype = tuple(part["shape"]), np.dtype(part["dtype"])
        size = math.prod(shape) * dtype.itemsize
        if size == 0:
            return np.empty(shape, dtype)
        if "offset" in part:
            if part["offset"] + size > self.path.stat().st_size:
                reason = f"is truncated: {part['name']!r} ends beyond its end"
                raise DataError(self.path, reason, "Copy it again")
            return np.memmap(self.path, dtype, mode="r", offset=part["offset"], shape=shape)
        values = new_array((size,), np.uint8)
        view, fill = values.data, 0
        while fill < size:
            fill += self._wait_into(view[fill:])
        return np.asarray(values.view(dtype).reshape(shape))

    def _wait_into(self, view: memoryview) -> int:
        """Read the bytes that have arrived, at least one."""
        pipe = self._child.stdout
        assert pipe is not None
        if not select.select([pipe], [], [], self._patience)[0]:
            self._child.kill()
            self._child.wait()
            reason = f"is damaged: reading it stood still for {self._patience:.0f} s"
            raise DataError(self.path, reason, self._remedy)
        read = pipe.readinto(view)  # type: ignore[attr-defined]
        if not read:
            raise self._end_of_child()
        return int(read)

    def _end_of_child(self) -> DataError:
        code = self._child.wait()
        if code == REFUSED:
            self._stderr.seek(0)
            with suppress(ValueError, LookupError, TypeError):  # a library may end with this code, too
                said = json.loads(self._stderr.read().splitlines()[-1])
                return DataError(self.path, said["error"], said["remedy"])
        how = f"ended with code {code}"
        if code < 0:
            with suppress(ValueError):
                how = f"crashed ({signal.Signals(-code).name})"
        complaint = self._complaint()
        reason = f"is damaged: the library that reads it {how}" + (f": {complaint}" if complaint else "")
        return DataError(self.path, reason, self._remedy)

    def _complaint(self) -> str:
        """What the library wrote on stderr, shortened; "" for nothing."""
        self._stderr.seek(0)
        text = self._stderr.read(1 << 16).decode("utf-8", "replace")
        text = "\n".join(line for line in text.splitlines() if not any(map(line.__contains__, _HARMLESS)))
        self._warned = "ERR|" not in text and any(map(text.__contains__, _WARNINGS)) and _LOST not in text
        for mark in ("ERR|", "WARN|"):  # VTK's lines: date, time, thread, place, level, text
            text = text.split(mark, 1)[-1]
        text = re.split(r"\n\x1b?[^ \n]*\d{4}-\d\d-\d\d ", text)[0]
        words = " ".join(re.sub(r"\x1b\[[0-9;]*m| \(0x[0-9a-f]+\)", "", text).split())
        words = re.sub(r"WARNING: In \S+, line \d+ (\w+: )?", "", words)  # ITK's
        return words if len(words) <= _MESSAGE else words[: _MESSAGE - 1] + "…"


_WRITERS = {
    "hdf5": "h5py or netCDF4",
    "zarr_store": "zarr or xarray",
    "minc": "mnc2nii (.nii)",
    "vtk_data": "VTK or ParaView",
    "itk": "SimpleITK (a folder: all its slices)",
    "slices": "tifffile or Pillow",
    "decoding": "the program that made it",
}


class Stored:
    """A container of named arrays, :class:`~.datasets.readers.container.Container`: HDF5 or Zarr.

    Contiguous arrays of HDF5 are mapped into memory.
    """

    def __init__(self, path: Path, library: str) -> None:
        self._child = Sandbox(path, library)
        self.arrays: dict[str, Array] = {}
        for answer in self._child.ask(list=True)[0]["entries"]:
            shape, dtype = tuple(answer["shape"]), np.dtype(answer["dtype"])
            name, dims, spacing = answer["name"], tuple(answer["dims"]), answer.get("spacing")
            size = None if spacing is None else (spacing[0], spacing[1], spacing[2])
            self.arrays[name] = Array(name, shape, dtype, dims, answer["attributes"], size)

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension."""
        return self._child.ask(read=name, first=first)[1]["values"]


class Foreign:
    """The grids and meshes of a file, :class:`~.datasets.readers.fields.Source`."""

    def __init__(self, path: Path, library: str) -> None:
        self.path = path
        self._child = Sandbox(path, library)
        answer, _ = self._child.ask(list=True)
        self.variables = tuple(
            Variable(
                v["name"],
                tuple(v["dims"]) if v["dims"] else None,
                v["steps"],
                v["components"],
                v.get("channels", 0),
            )
            for v in answer["variables"]
        )
        if not self.variables:
            remedy = "Write point or cell data of a three-dimensional grid or mesh with it"
            raise DataError(path, "holds no numeric field", remedy)

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        answer, parts = self._child.ask(read=choice.variable.name, step=choice.step)
        values = scalar(parts["values"], choice, self.path)
        mask = parts["mask"].view(np.bool_) if "mask" in parts else None
        if "points" in parts:
            from econgs_bench.datasets.readers.mesh import Mesh, resampled

            mesh = Mesh(parts["points"], parts["connectivity"], parts["ends"], parts["types"])
            checked = Mesh.joined([mesh], self.path)
            return resampled(checked, values, answer["of_cells"], choice, self.path, mask)
        from econgs_bench.datasets.readers.axes import place

        axes = [parts.get(name) for name in "xyz"]
        return place(values, axes, self.path, choice.limits, mask)


def _start(options: list[str], stderr: Any) -> subprocess.Popen[bytes]:
    child = [sys.executable, "-P", "-W", "ignore", "-m", "econgs_bench.datasets.readers.child"]
    return subprocess.Popen(
        [*child, *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        bufsize=0,
    )


def _size(path: Path) -> int:
    """Bytes of a file, or of the files of its folder, where many formats keep their data."""
    try:
        folder = path.parent if path.suffix == ".foam" else path
        beside = list(folder.rglob("*")) if folder.is_dir() else [path, *path.parent.glob(f"{path.stem}*")]
        return sum(file.stat().st_size for file in beside if file.is_file())
    except OSError:
        return 0


def _memory(size: int) -> int:
    """Limit of a child in bytes: ample for the file, at least 4 GiB, and no more than the machine has."""
    import psutil

    return int(min(max(_MEMORY, 16 * size), psutil.virtual_memory().total))


def _end(child: subprocess.Popen[bytes], stderr: Any) -> None:
    child.kill()
    child.wait()
    for pipe in (child.stdin, child.stdout, stderr):
        if pipe is not None:
            pipe.close()
