"""The readers' child process as a fork of this one: a mutation costs no interpreter."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from econgs_bench.datasets.readers import sandbox
from econgs_bench.datasets.readers.child import __main__ as child

_M_PERTURB = -6  # of glibc's malloc: new memory is filled with a byte


class Fork:
    """What :mod:`.datasets.readers.sandbox` needs of a ``Popen``.

    Args:
        perturb: byte that fills new memory of the child, so that garbage differs between two values of it.
    """

    def __init__(self, options: list[str], stderr: Any, perturb: int = 0) -> None:
        requests, answers = os.pipe(), os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            self._serve(options, stderr.fileno(), requests, answers, perturb)
        os.close(requests[0])
        os.close(answers[1])
        self.stdin, self.stdout = os.fdopen(requests[1], "wb", 0), os.fdopen(answers[0], "rb", 0)
        self._code: int | None = None

    def _serve(self, options: list[str], stderr: int, requests: Any, answers: Any, perturb: int) -> None:
        code = 70
        try:
            os.dup2(requests[0], 0)
            os.dup2(answers[1], 1)
            os.dup2(stderr, 2)
            os.closerange(3, 256)
            ctypes.CDLL(None).mallopt(_M_PERTURB, perturb)
            sys.stdin, sys.stderr = open(0, closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
            sys.argv = ["child", *options]
            child.main()
            code = 0
        finally:
            os._exit(code)

    def kill(self) -> None:
        if self._code is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> int:
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._code

    def poll(self) -> int | None:
        return self._code


def use_forks(monkeypatch: pytest.MonkeyPatch, perturb: int = 0) -> None:
    """Fork the children from here on; what they need is imported once, in this process."""

    def start(options: list[str], stderr: Any) -> Fork:
        library, path = options[:2]
        module = import_module(f"econgs_bench.datasets.readers.child.{library}")
        if library == "vtk_data":
            reader = module.READERS[module.suffix_of(Path(path), set(module.READERS))]
            import_module(f"vtkmodules.{reader.partition('.')[0]}")
            # Threads that VTK started here are not in a fork, which would wait for them.
            import_module("vtkmodules.vtkCommonCore").vtkSMPTools.SetBackend("Sequential")
        gc.freeze()  # a collection in a fork would copy all pages
        return Fork(options, stderr, perturb)

    monkeypatch.setattr(sandbox, "_start", start)
