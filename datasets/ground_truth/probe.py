"""The Mitsuba backend that works here, by trials in subprocesses.

Dr.Jit compiles through libLLVM. On Linux x86-64 a wheel among the dependencies brings one into the
environment; elsewhere it is the system's. Versions 15 and 16 load but abort the whole process at the first
float minimum or maximum, which Python cannot catch. So every candidate library has a trial in a process of
its own, the environment's first, then the system's from the newest on, and the verdict is kept for that file.
"""

from __future__ import annotations

import glob
import hashlib
import importlib.util
import json
import os
import re
import signal
import site
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scratch import cache_root

REMEDY = (
    "Install LLVM 17 or newer (Debian, Ubuntu: apt-get install libllvm19; macOS: brew install llvm), or set "
    "DRJIT_LIBLLVM_PATH to its shared library"
)

_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)
_PATIENCE = 120.0  # seconds; a trial takes one on a machine that is not busy
# The literal in the kernel differs each time, so that no kernel cached on disk hides a compiler that fails.
_TRIAL = """
import sys
import drjit as dr
from drjit.{backend} import Float
x = dr.minimum(Float([1.0, 4.0]) + {salt!r}, Float([3.0, 2.0]))
assert abs(dr.sum(x)[0] - (3.0 + {salt!r})) < 1e-4
sys.stdout.write("works")
"""


@dataclass(frozen=True)
class Backend:
    """A backend of Mitsuba.

    Attributes:
        name: "cuda", "llvm" or "none".
        library: path of libLLVM for "llvm", else "".
        reason: why there is none, else "".
        remedy: what would give one, where there is none.
    """

    name: Literal["cuda", "llvm", "none"]
    library: str = ""
    reason: str = ""
    remedy: str = REMEDY


@cache
def find_backend(cuda: bool = True) -> Backend:
    """The backend to use, CUDA first; the first call on a machine takes about a second, later ones none.

    Args:
        cuda: whether it may be CUDA.

    Raises:
        DataError: a candidate could not be tried, so that nothing is decided.
    """
    lacking = [name for name in ("mitsuba", "drjit") if importlib.util.find_spec(name) is None]
    if lacking:
        missing = " and ".join(lacking)
        return Backend("none", reason=f"{missing} not installed", remedy=f"pip install {' '.join(lacking)}")
    if cuda and _has_cuda_driver() and not _trial_failure("cuda", ""):
        return Backend("cuda")
    choice = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    candidates = [choice] if choice else libllvm_candidates()
    failures = []
    for library in candidates:
        failure = _trial_failure("llvm", library)
        if not failure:
            return Backend("llvm", library)
        failures.append(f"{library} {failure}")
    return Backend("none", reason="; ".join(failures) or "no libLLVM was found")


def activate(backend: Backend) -> None:
    """Import Mitsuba and set its variant for a backend of :func:`find_backend`.

    It has as many threads as the native kernels, where ECONGS_THREADS sets their number.
    """
    if backend.library:
        os.environ["DRJIT_LIBLLVM_PATH"] = backend.library  # read when Dr.Jit initialises LLVM
    import drjit
    import mitsuba

    mitsuba.set_variant(f"{backend.name}_ad_rgb")
    if threads := os.environ.get("ECONGS_THREADS"):
        drjit.set_thread_count(int(threads))


def libllvm_candidates() -> list[str]:
    """Shared libraries of LLVM 15 and newer, each file once: the environment's, then those in usual places.

    The newest is first among each.
    """
    own = [
        sys.prefix,
        sysconfig.get_path("data"),
        site.getuserbase(),
    ]  # of an environment, of pip install --user
    others = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    versions: dict[str, tuple[bool, tuple[int, ...]]] = {}
    for ours, patterns in ((True, _in_folders(own)), (False, [*_PATTERNS, *_in_folders(others)])):
        for path in (found for pattern in patterns for found in glob.glob(pattern)):
            real = os.path.realpath(path)
            digits = re.search(r"libLLVM-?(?:\.so\.|\.dylib)?(\d+(?:\.\d+)*)", os.path.basename(real))
            number = tuple(int(d) for d in digits[1].split(".")) if digits else (0,)
            if os.path.isfile(real) and (number[0] >= 15 or not digits):
                versions.setdefault(real, (ours, number))
    return sorted(versions, key=lambda path: (versions[path], path), reverse=True)


def _in_folders(folders: Iterable[str]) -> list[str]:
    return [f"{folder}/{lib}libLLVM*.so*" for folder in folders if folder for lib in ("", "lib/")]


def _has_cuda_driver() -> bool:
    return any(os.path.exists(p) for p in ("/dev/nvidiactl", "/dev/dxg"))


def _trial_failure(backend: str, library: str) -> str:
    """Empty if a kernel ran, else what happened; remembered per library file and Dr.Jit version."""
    if library and not os.path.isfile(library):
        return "does not exist"
    # The folder's time too: the wheel's library needs links beside it, which the first start of Python lays.
    files = [library, os.path.dirname(library) or "."] if library else []
    stamp = [os.stat(path).st_mtime_ns for path in files]
    device = os.environ.get("CUDA_VISIBLE_DEVICES", "") if backend == "cuda" else ""
    key = f"{backend} {library} {stamp} {device} drjit {version('drjit')}"
    record = cache_root() / "probe" / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.json"
    try:
        return str(json.loads(record.read_text(encoding="utf-8"))["failure"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    failure = _try(backend, library)
    _remember(record, key, failure)
    return failure


def _try(backend: str, library: str) -> str:
    """Run a kernel in a subprocess: empty if it worked, else what went wrong and would again.

    Raises:
        DataError: the machine ended the trial, so that it decides nothing.
    """
    environment = dict(os.environ)
    if library:
        environment["DRJIT_LIBLLVM_PATH"] = library
    salt = int.from_bytes(os.urandom(2), "big") / 2**20
    trial = _TRIAL.format(backend=backend, salt=salt)
    try:
        done = subprocess.run(
            [sys.executable, "-c", trial],
            env=environment,
            capture_output=True,
            encoding="utf-8",
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise _undecided(backend, library, f"did not end within {_PATIENCE:g} s") from error
    except OSError as error:
        raise _undecided(backend, library, f"cannot start ({error})") from error
    if done.returncode in (-signal.SIGKILL, -signal.SIGTERM):
        raise _undecided(backend, library, f"was killed (signal {-done.returncode})")
    if done.returncode == 0 and done.stdout.endswith("works"):
        return ""
    if done.returncode < 0:
        return f"aborts the process when Dr.Jit compiles with it (signal {-done.returncode})"
    lines = done.stderr.strip().splitlines()
    return f"cannot be used by Dr.Jit ({lines[-1] if lines else f'exit status {done.returncode}'})"


def _undecided(backend: str, library: str, reason: str) -> DataError:
    """No other renderer takes over: pictures of one run would come from two."""
    choice = 'CUDA_VISIBLE_DEVICES="" hides the GPU from it'
    if library:
        choice = 'DRJIT_LIBLLVM_PATH names another libLLVM, or with "none" the slow reference marcher'
    return DataError(
        f"Mitsuba with {library or backend}",
        f"its trial {reason}",
        f"Run again when the machine is less busy; {choice}",
    )


def _remember(record: Path, key: str, failure: str) -> None:
    aside = record.with_suffix(f".{os.getpid()}")
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        aside.write_text(json.dumps({"key": key, "failure": failure}), encoding="utf-8")
        os.replace(aside, record)
    except OSError:  # a read-only cache costs a second each time, no more
        with suppress(OSError):
            aside.unlink()
