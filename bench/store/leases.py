"""Leases: of all processes on all machines that share a run store, one works on a job.

    RUNS/locks/<name>/<token>

Network file systems may lack locks, or free them while their holder lives. So a lease is made of renames
alone, which they do at once or not at all: a folder with the holder's token is renamed in place, which fails
while another token is there. A token names machine, process and its start; its time of change is the
heartbeat.

A lease is free once it is released, or its holder has died (seen from the same machine), or its heartbeat is
older than :data:`EXPIRY` (seen from another machine, or if the holder is stopped). Who takes it over renames
the token. The former holder finds its own missing, and must put nothing in place.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import shutil
import time
import uuid
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Self

import psutil

EXPIRY = 120.0
"""Seconds without a heartbeat after which a lease is free."""
BEAT = 10.0
"""Seconds between heartbeats."""
_POLL = 0.05
_SAME_START = 5.0
"""Seconds by which the system's word on a process's start may differ between two readings."""


class Held(Exception):
    """Another process has the lease."""


class Lost(Exception):
    """The lease was taken over: this process must not write."""


class Lease:
    """A lease of a name, not held at first.

    Args:
        folder: of its token; its parent exists.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._token: str | None = None

    def acquire(self, timeout: float | None = None) -> Self:
        """Take the lease; as a context, it is released at the end.

        Args:
            timeout: seconds to wait for another holder; default: as long as it takes.

        Raises:
            Held: another process still has it.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not (self._take() or self._take_over()):
            if end is not None and time.monotonic() >= end:
                raise Held(self._folder.name)
            time.sleep(_POLL)
        return self

    def __enter__(self) -> Self:
        return self if self._token is not None else self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def renew(self) -> None:
        """Give a heartbeat; without the lease, do nothing.

        Raises:
            Lost: another process has taken the lease over.
        """
        if (token := self._token) is not None:
            try:
                os.utime(self._folder / token)
            except FileNotFoundError:
                if self._token is not None:  # else released meanwhile by another thread
                    raise Lost(self._folder.name) from None

    def release(self) -> None:
        """Give the lease up; without it, do nothing."""
        token, self._token = self._token, None
        if token is not None:
            with suppress(OSError):  # lost, or the next holder is there already
                os.unlink(self._folder / token)
                os.rmdir(self._folder)

    @property
    def is_held(self) -> bool:
        """Whether any process has the lease now."""
        token = self._present()
        return token is not None and _lives(token)

    def _take(self) -> bool:
        """Put a token in place, if none is there."""
        if self._present() is not None:
            return False
        token = _token()
        aside = self._folder.with_name(f".{token}")
        aside.mkdir()
        (aside / token).touch()
        try:
            os.rename(aside, self._folder)  # an empty folder there yields
        except OSError as error:
            shutil.rmtree(aside, ignore_errors=True)
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            return False
        self._token = token
        return True

    def _take_over(self) -> bool:
        """Take the lease of a holder that is gone; of several that try, one succeeds."""
        before = self._present()
        if before is None or _lives(before):
            return False
        if before.is_dir():  # no token, and no file that another name makes one
            shutil.rmtree(before, ignore_errors=True)
            return self._take()
        token = _token()
        try:
            os.utime(before)
            os.rename(before, before.with_name(token))
        except FileNotFoundError:
            return False
        self._token = token
        return True

    def _present(self) -> Path | None:
        """The token in place; what a network file system hides there is none."""
        try:
            return next((path for path in self._folder.iterdir() if path.name[0] != "."), None)
        except FileNotFoundError:
            return None


def _token() -> str:
    """Node, machine, process, its start and a random number."""
    process = psutil.Process()
    parts = (platform.node(), _machine(), process.pid, int(process.create_time()), uuid.uuid4().hex[:8])
    return "-".join(map(str, parts))


def _lives(token: Path) -> bool:
    """Whether the holder is alive, as far as can be known from here; of a foreign file, its time decides."""
    machine, pid, start = [*token.name.rsplit("-", 4), "", "", ""][1:4]
    if machine == _machine():
        try:
            process = psutil.Process(int(pid))
            same = abs(process.create_time() - float(start)) < _SAME_START
            state = process.status()
        except psutil.NoSuchProcess:
            return False
        if not same or state == psutil.STATUS_ZOMBIE:
            return False
        if state != psutil.STATUS_STOPPED:
            return True
    try:
        with token.open("rb") as file:  # a network file system looks anew when a file is opened
            beat = os.fstat(file.fileno()).st_mtime
    except (FileNotFoundError, IsADirectoryError):
        return False
    return abs(_now(token.parent.parent) - beat) < EXPIRY  # of a store that was received, it may be to come


def _now(folder: Path) -> float:
    """Time by the clock of a folder's file server, which is the clock of heartbeats."""
    probe = folder / f".{uuid.uuid4().hex}"
    try:
        probe.touch()
        try:
            return probe.stat().st_mtime
        finally:
            probe.unlink()
    except OSError:  # the folder cannot be written
        return time.time()


@cache
def _machine() -> str:
    """What processes share that see each other's process ids: node, boot and namespace."""
    parts = [platform.node()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        with suppress(OSError):
            parts.append(read())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]
