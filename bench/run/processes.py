"""The processes of workers: interpreters of their own, or forks of a server that has torch imported.

A fork spares a job the import of torch (1.5 s). Run as ``python -m econgs_bench.bench.run.processes FD``,
this module is the server. It imports torch and the harness and does nothing else: workers import the methods.
An operation on tensors would start threads that a fork does not inherit, and the first such operation of a
worker would wait for them forever.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import os
import select
import signal
import socket
import subprocess
import sys
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

import psutil

from econgs_bench.datasets import orphans

MODULES = ("torch", "scipy.spatial", "econgs_bench.bench.run.worker", "econgs_bench.bench.machine.provenance")
"""What every job with torch imports, so that a fork takes no more memory than an interpreter of its own."""
SERVER = "econgs_bench.bench.run.processes"
_POLL_SECONDS = 0.02
_LAST_SECONDS = 0.5
_SWEEPS = 20
"""A leftover may have forked while it was killed."""


class Fork:
    """A forked worker, with those parts of the interface of ``subprocess.Popen`` that the executor uses.

    Attributes:
        pid: process id; the worker leads a session of its own.
        returncode: exit code, or minus the signal that killed it; None while it runs.
    """

    def __init__(self, connection: socket.socket, pid: int) -> None:
        self._connection = connection
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Exit code. A worker whose server has died is killed: how it ends could not be learned.

        Raises:
            subprocess.TimeoutExpired: it still runs after ``timeout`` seconds.
        """
        if self.returncode is None:
            if not select.select([self._connection], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("worker", timeout or 0.0)
            code = _receive(self._connection)
            if code is None:
                end_session(self.pid)
            self.returncode = -signal.SIGKILL if code is None else code
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)


Process = subprocess.Popen[bytes] | Fork


class Processes:
    """Starts workers, one at a time.

    Args:
        environment: of all workers. Torch reads it when the server imports it.

    Attributes:
        server: the process that workers are forked from, if it was started.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = dict(environment)
        self.server: subprocess.Popen[bytes] | None = None
        self._connection: socket.socket | None = None
        self._before: set[int] = set()

    def start(
        self, folder: Path, log: IO[bytes], module: str = "econgs_bench.bench.run.worker"
    ) -> subprocess.Popen[bytes]:
        """A worker in an interpreter of its own, which writes to ``log``."""
        return self._launch(module, str(folder), output=log)

    def fork(self, folder: Path, log: IO[bytes]) -> Process:
        """A worker forked from the server, which is started (again) if it does not run."""
        for _ in range(2):
            self.prepare()
            assert self._connection is not None
            with contextlib.suppress(OSError):
                socket.send_fds(self._connection, [os.fsencode(folder)], [log.fileno()])
                if (pid := _receive(self._connection)) is not None:
                    return Fork(self._connection, pid)
            self.close()
        return self.start(folder, log)

    def prepare(self) -> None:
        """Start the server, if it does not run; its imports go on after the return."""
        if self.server is not None:
            return
        self._connection, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            number = theirs.fileno()
            self.server = self._launch(SERVER, str(number), output=subprocess.DEVNULL, pass_fds=[number])

    def _launch(
        self, *arguments: str, output: IO[bytes] | int, pass_fds: Sequence[int] = ()
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            pass_fds=pass_fds,
            env=self._environment,
        )

    @contextlib.contextmanager
    def adopting(self) -> Iterator[None]:
        """For as long as this lasts, orphans of workers become children of this process (on Linux).

        Those that are left at its end are ended: nobody would wait for them later.
        """
        self._before = {child.pid for child in psutil.Process().children(recursive=True)}
        with orphans.adopting():
            try:
                yield
            finally:
                self.end_leftovers()

    def end_leftovers(self) -> list[str]:
        """Kill what a worker that has ended left running: names and process ids, for people.

        A worker leads a session of its own, which its descendants can leave for new ones only. So leftovers
        are the descendants of this process in other sessions, without those that were there before.
        """
        names: list[str] = []
        if not (left := self._leftovers()):
            return names
        psutil.wait_procs(left, _LAST_SECONDS)  # helpers that end with their parent clean up
        for _ in range(_SWEEPS):
            if not (left := self._leftovers()):
                break
            for process in left:
                with contextlib.suppress(psutil.Error):
                    if process.status() != psutil.STATUS_ZOMBIE:
                        names.append(f"{process.name()} ({process.pid})")
                        process.kill()
            psutil.wait_procs(left, _LAST_SECONDS)
        return names

    def _leftovers(self) -> list[psutil.Process]:
        spared = self._before | ({self.server.pid} if self.server is not None else set())
        here = os.getsid(0)
        descendants = psutil.Process().children(recursive=True)
        return [p for p in descendants if p.pid not in spared and _session(p.pid) not in (None, here)]

    def close(self) -> None:
        """End the server."""
        if self.server is not None and self._connection is not None:
            self._connection.close()
            self.server.kill()
            self.server.wait()
            self.server = self._connection = None


def _session(pid: int) -> int | None:
    try:
        return os.getsid(pid)
    except OSError:
        return None


def end_session(pid: int) -> None:
    """Kill a worker and all that it started."""
    for kill in (os.killpg, os.kill):  # a fork leads a session only a moment after its start
        with contextlib.suppress(ProcessLookupError):
            kill(pid, signal.SIGKILL)


def _receive(connection: socket.socket) -> int | None:
    """The next number of the server; None once it has died."""
    try:
        return int(connection.recv(64))
    except (OSError, ValueError):
        return None


def serve(connection: socket.socket) -> Path | None:
    """Fork a worker for each folder that arrives, and answer its process id and, later, its exit code.

    Returns:
        In each worker its folder. In the server None, once the executor is gone; its worker then stops.
    """
    for name in MODULES:
        importlib.import_module(name)
    pages = _resident_pages()
    gc.collect()
    gc.freeze()  # workers need not look through all of torch
    while True:
        folder, logs, _, _ = socket.recv_fds(connection, 2**16, 1)
        if not folder:
            return None
        pid = os.fork()
        if pid == 0:
            os.setsid()
            connection.close()
            for output in (1, 2):
                os.dup2(logs[0], output)
            os.close(logs[0])
            for page in pages:
                ctypes.c_char.from_address(page).value  # noqa: B018
            return Path(os.fsdecode(folder))
        os.close(logs[0])
        connection.send(b"%d" % pid)
        while (ended := os.waitpid(pid, os.WNOHANG))[0] == 0:
            if select.select([connection], [], [], _POLL_SECONDS)[0]:
                return None
        connection.send(b"%d" % os.waitstatus_to_exitcode(ended[1]))


def _resident_pages() -> list[int]:
    """Addresses of the pages of mapped files (libraries) that are resident in this process.

    A fork starts without them, so that its memory would not count what an interpreter of its own does.
    """
    size = os.sysconf("SC_PAGE_SIZE")
    pages: list[int] = []
    with open("/proc/self/maps", encoding="utf-8") as maps, open("/proc/self/pagemap", "rb") as table:
        for line in maps:
            span, mode, _, _, inode, *_ = line.split()
            start, end = (int(address, 16) for address in span.split("-"))
            if mode[0] == "r" and inode != "0":
                table.seek(start // size * 8)
                entries = array("Q", table.read((end - start) // size * 8))
                pages += [start + i * size for i, entry in enumerate(entries) if entry >> 63]
    return pages


def main() -> int:
    """Serve; in a worker, run its job."""
    folder = serve(socket.socket(fileno=int(sys.argv[1])))
    if folder is None:
        return 0
    from econgs_bench.bench.run import worker

    worker.end(worker.main(folder))


if __name__ == "__main__":
    sys.exit(main())
