"""Runs a command of another program: its output, memory and time watched, nothing of it left running."""

from __future__ import annotations

import contextlib
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.orphans import adopting

LOG_BYTES = 1 << 20
"""Output of a command that goes into the log; the rest is read and dropped."""
MOST_FILES = 200_000
"""Files that a command may have in its folder."""
_LINE_BYTES = 1 << 14
_LOOK, _DISK_LOOK, _DEVICE_LOOK = 0.1, 1.0, 2.0
_PAUSE = 50.0
"""Looks take this part of a processor's time: they must not slow down what is timed."""
_NOT_PASSED = ("PYTHONSAFEPATH", "PYTHONPATH", "PYTHONHOME", "PYTHONIOENCODING", "VIRTUAL_ENV")
"""Variables of this program's own interpreter, which would mislead another one."""
_NO_MEMORY = re.compile(r"out of memory|MemoryError|bad_alloc", re.IGNORECASE)


@dataclass(frozen=True)
class Usage:
    """What a command took.

    Attributes:
        seconds: from its start to its end.
        host_bytes: peak of its processes together; None where it ended before anyone looked.
        device_bytes: the same on GPUs, by ``nvidia-smi`` every two seconds; None where unknown.
    """

    seconds: float
    host_bytes: int | None
    device_bytes: int | None


def environment(device: str, variables: Mapping[str, str]) -> dict[str, str]:
    """The variables of a command: this program's, without those of its interpreter. It sees one device."""
    own = {name: value for name, value in os.environ.items() if name not in _NOT_PASSED}
    own["PYTHONUNBUFFERED"] = "1"
    kind, _, number = device.partition(":")
    if kind == "cpu":
        own["CUDA_VISIBLE_DEVICES"] = ""
    elif number:
        own["CUDA_VISIBLE_DEVICES"] = number
    return own | dict(variables)


def run(
    command: Sequence[str],
    *,
    what: str,
    cwd: Path,
    variables: Mapping[str, str],
    timeout: float | None = None,
    folder: Path | None = None,
    most_bytes: int = 0,
    device: str = "cpu",
    heard: Callable[[str], None] = lambda line: None,
    logged: bool = True,
) -> Usage:
    """Run a command to its end.

    Args:
        command: program and arguments.
        what: names it in errors.
        cwd: where it starts.
        variables: all of its environment.
        timeout: seconds; None: no limit of its own.
        folder: whose files are watched; None: none.
        most_bytes: that the folder may hold.
        device: "cpu" or "cuda".
        heard: takes each line of its output. What it raises ends the command.
        logged: print its output, as a job does for its log; else the last lines alone, where it fails.

    Raises:
        DataError: it cannot be started, or ends with another exit code than 0, for its time or for its files.
        MemoryError: it says that memory ran out.
    """
    watch = _Watch(folder, most_bytes, device, what)
    tail: deque[str] = deque(maxlen=5)
    room = LOG_BYTES if logged else 0

    def line(data: bytes, ended: bool) -> None:
        nonlocal room
        text = printable(data.decode("utf-8", "replace").rstrip()).expandtabs()
        if text:
            tail.append(text)
            if ended and room > 0:  # a line that is drawn over and over is no log
                room -= len(text) + 1
                print(text if room > 0 else "bench: the rest of its output is not kept", flush=True)
            heard(text)

    with _all_ended():
        start = time.perf_counter()
        try:
            process = subprocess.Popen(
                list(command), cwd=cwd, env=dict(variables), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        except (OSError, ValueError) as error:
            reason = f"cannot start {command[0]} ({getattr(error, 'strerror', None) or error})"
            raise DataError(what, reason, "Correct [environment] or the command, or install it") from error
        assert process.stdout is not None
        try:
            for data, ended in _lines(process):
                if data is not None:
                    line(data, ended)
                watch.look(process.pid)
                if timeout is not None and time.perf_counter() - start > timeout:
                    reason = f"was ended after {timeout:g} s, its timeout"
                    raise DataError(what, reason, "Raise `timeout` in its TOML file, or mend what hangs")
        finally:
            process.stdout.close()
        code = process.wait()
        usage = Usage(time.perf_counter() - start, watch.host_bytes, watch.device_bytes)
    if code != 0:
        how = f"exit code {code}" if code > 0 else signal.Signals(-code).name
        if not logged:
            print("\n".join(tail), file=sys.stderr)
        words = f"ended with {how}" + (f": {tail[-1][:300]}" if tail else ", without output")
        if any(_NO_MEMORY.search(one) for one in tail):
            raise MemoryError(f"{what} {words}")
        raise DataError(what, words, "Mend the command; its output is in the log of the job")
    return usage


@contextmanager
def _all_ended() -> Iterator[None]:
    """End every process that began inside, also those that left their parents."""
    before = {child.pid for child in psutil.Process().children(recursive=True)}

    def left() -> list[psutil.Process]:
        return [one for one in psutil.Process().children(recursive=True) if one.pid not in before]

    with adopting():
        try:
            yield
        finally:
            for _ in range(20):  # one may have forked while it was killed
                if not (found := left()):
                    break
                for one in found:
                    with contextlib.suppress(psutil.Error):
                        one.kill()
                psutil.wait_procs(found, 0.5)


def _lines(process: subprocess.Popen[bytes]) -> Iterator[tuple[bytes | None, bool]]:
    """Lines of the output, and whether a line feed ends them; (None, False) each moment without any.

    Ends with the process: what it left running may hold its output open.
    """
    assert process.stdout is not None
    pipe = process.stdout.fileno()
    os.set_blocking(pipe, False)
    rest = b""
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while True:
            gone = process.poll() is not None
            if not gone:
                selector.select(_LOOK)
            try:
                data = os.read(pipe, 1 << 16)
            except BlockingIOError:
                data = None
            if data:
                rest += data
                *whole, rest = re.split(rb"(\r\n|\n|\r)", rest)
                for text, end in zip(whole[::2], whole[1::2], strict=True):
                    yield text[:_LINE_BYTES], end != b"\r"
                if len(rest) > _LINE_BYTES:
                    yield rest[:_LINE_BYTES], True
                    rest = b""
            elif gone:
                break
            elif data == b"":  # it closed its output and goes on
                selector.unregister(pipe)
                while process.poll() is None:
                    yield None, False
                    time.sleep(_LOOK)
                break
            yield None, False
    if rest:
        yield rest, True


class _Watch:
    """Looks at the memory of a command's processes and at the files of its folder."""

    def __init__(self, folder: Path | None, most_bytes: int, device: str, what: str) -> None:
        self._folder, self._most, self._what = folder, most_bytes, what
        self._smi = shutil.which("nvidia-smi") if device.startswith("cuda") else None
        self._next = self._disk = self._device = 0.0
        self.host_bytes: int | None = None
        self.device_bytes: int | None = None

    def look(self, pid: int) -> None:
        now, begin = time.monotonic(), time.thread_time()
        if now < self._next:
            return
        with contextlib.suppress(psutil.Error):
            leader = psutil.Process(pid)
            found = [leader, *leader.children(recursive=True)]
            held = sum(one.memory_info().rss for one in found)
            peaks = [peak_host_bytes(one.pid) or 0 for one in found]  # of a moment between two looks
            if (most := max(held, *peaks)) > 0:  # one that has ended holds nothing, and nobody saw more
                self.host_bytes = max(self.host_bytes or 0, most)
            if self._smi is not None and now - self._device >= _DEVICE_LOOK:
                self._device = now
                self._look_at_device({one.pid for one in found})
        self._next = now + max(_LOOK, _PAUSE * (time.thread_time() - begin))
        if self._folder is not None and now >= self._disk:
            start = time.thread_time()
            self._look_at_files(self._folder)
            self._disk = now + max(_DISK_LOOK, _PAUSE * (time.thread_time() - start))

    def _look_at_device(self, pids: set[int]) -> None:
        query = ["--query-compute-apps=pid,used_memory", "--format=csv,noheader,nounits"]
        with contextlib.suppress(OSError, subprocess.SubprocessError, ValueError):
            done = subprocess.run(
                [str(self._smi), *query], capture_output=True, encoding="ascii", timeout=5, check=True
            )
            rows = [row.split(",") for row in done.stdout.splitlines() if row.strip()]
            used = sum(int(size) for pid, size in rows if int(pid) in pids) * 2**20
            if used:
                self.device_bytes = max(self.device_bytes or 0, used)

    def _look_at_files(self, folder: Path) -> None:
        files = held = 0
        for root, _, names in os.walk(folder):
            files += len(names)
            for name in names:
                with contextlib.suppress(OSError):
                    held += os.lstat(os.path.join(root, name)).st_blocks * 512
            if files > MOST_FILES or held > self._most:
                reason = f"was ended: its folder holds {files} files of {held / 2**20:.0f} MiB"
                raise DataError(
                    self._what, f"{reason}, at most {MOST_FILES} of {self._most / 2**20:.0f} MiB",
                    "Mend the program, or raise `disk` in its TOML file",
                )  # fmt: skip
