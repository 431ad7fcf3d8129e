"""Locks of this machine, which the processes of all its users take turns by.

A lock is one of the kernel on a file in the folder for temporary files. It needs no right to write: the file
belongs to whoever came first, and others open it to read. So nothing is written into it, and the kernel's
list says who holds the lock. Files stay: to remove one would give two processes a lock each.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from econgs_bench.datasets.errors import DataError

_REMEDY = "Set BENCH_LOCKS to a folder of a disk of this machine that its users share"
_POLL_SECONDS = 0.05


def lock_file(name: str) -> Path:
    """The file of a lock of this machine.

    The environment variable BENCH_LOCKS names another folder for it; runs that share it do not overlap.
    """
    folder = Path(os.environ.get("BENCH_LOCKS") or tempfile.gettempdir())
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o1777)  # as that for temporary files: all may add theirs
    return folder / f"econgs-bench-{name}.lock"


@contextmanager
def locked(name: str, *, shared: bool = False, wait: bool = True) -> Iterator[None]:
    """Hold a lock of this machine.

    Args:
        name: of the lock.
        shared: with others that hold it so, else alone.
        wait: until it is free.

    Raises:
        BlockingIOError: another process holds it, and ``wait`` is False.
        DataError: the file cannot be opened, or its folder has no locks.
    """
    if os.name != "posix":
        with _locked_without_flock(name, wait):
            yield
        return
    import fcntl

    operation = (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB)
    while True:
        handle = _opened(lock_file(name))
        try:
            try:
                fcntl.flock(handle, operation)
            except BlockingIOError:
                raise
            except OSError as error:
                reason = f"has no locks for this machine's timing ({error.strerror})"
                raise DataError(lock_file(name).parent, reason, _REMEDY) from error
            if os.fstat(handle).st_nlink:  # else another version of this program removed it meanwhile
                yield
                return
        finally:
            os.close(handle)


def check_locks() -> None:
    """Check that this process can take the locks of this machine: jobs would fail, or wait for ever.

    Raises:
        DataError: it cannot.
    """
    with locked("probe", shared=True):
        pass
    with suppress(BlockingIOError), locked("timing", shared=True, wait=False):
        pass


def holder(name: str) -> str:
    """Who holds a lock of this machine: user and process, as far as the kernel lists them; "" if nobody."""
    try:
        status = os.stat(lock_file(name))
        lines = Path("/proc/locks").read_text(encoding="ascii").splitlines()
    except OSError:
        return ""
    for line in lines:
        fields = line.split()
        if len(fields) < 8 or fields[1] != "FLOCK":
            continue
        if fields[5].rpartition(":")[2] == str(status.st_ino) and _is_device(fields[5], status.st_dev):
            with suppress(psutil.Error, ValueError):
                process = psutil.Process(int(fields[4]))
                return f"process {process.pid} of {process.username()}"
            return "a process of another container"
    return ""


def _is_device(text: str, device: int) -> bool:
    """Whether "major:minor:inode" in hex, hex and decimal is on a device; layered ones differ."""
    major, minor, _ = text.split(":")
    listed = os.makedev(int(major, 16), int(minor, 16))
    return listed == device or os.major(device) == 0


def _opened(path: Path) -> int:
    """A handle of a lock's file to read, made for all users if it is not there.

    Opened without O_CREAT first: in a folder with the sticky bit, Linux may refuse that for files of others
    (fs.protected_regular).
    """
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        while True:
            with suppress(FileNotFoundError):
                handle = os.open(path, flags)
                break
            with suppress(FileExistsError):
                handle = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
                os.fchmod(handle, 0o666)  # whatever the umask says
                break
    except OSError as error:
        reason = f"cannot be opened for this machine's timing ({error.strerror}){_owner(path)}"
        remedy = "Have its owner remove it, or give it to all (chmod a+r)" if path.exists() else _REMEDY
        raise DataError(path, reason, remedy) from error
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise DataError(
            path, f"is no file, and a lock of this machine's timing is one{_owner(path)}", _REMEDY
        )
    return handle


def _owner(path: Path) -> str:
    """Words on whose a file is."""
    try:
        number = path.lstat().st_uid
    except OSError:
        return ""
    try:
        import pwd

        return f"; it belongs to {pwd.getpwuid(number).pw_name}"
    except (ImportError, KeyError):
        return f"; it belongs to user {number}"


@contextmanager
def _locked_without_flock(name: str, wait: bool) -> Iterator[None]:
    """The same where the system has no shared locks on files: alone."""
    from filelock import FileLock, Timeout

    try:
        with FileLock(lock_file(name)).acquire(timeout=-1 if wait else 0, poll_interval=_POLL_SECONDS):
            yield
    except Timeout as error:
        raise BlockingIOError(str(error)) from error
