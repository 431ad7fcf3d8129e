"""Public files by HTTP: resumed where a transfer was cut, and checked before they get their names."""

from __future__ import annotations

import errno
import hashlib
import os
import queue
import re
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from econgs_bench.datasets.errors import DataError

if TYPE_CHECKING:
    from requests import Response

PAUSES = (1.0, 2.0, 4.0)
"""Seconds before each further attempt, once a server has answered."""
TIMEOUT = 30.0
"""Seconds without a byte after which a connection counts as cut."""
WINDOW = 60.0
LEAST_RATE = 4096
"""Bytes a second, over each such window of seconds, below which a transfer counts as cut.

So a server that sends single bytes holds nobody, and a file takes at most its size over this rate.
"""
UNKNOWN_SIZE = 2 * 2**30
"""Bytes of a file at most whose size neither the catalogue nor the server gives."""
_CHUNK = 1 << 16
_REMEDY = "Run the command again to resume"


@dataclass(frozen=True)
class Remote:
    """A file at a server.

    Attributes:
        url: address, http or https.
        algorithm: name of a hash in :mod:`hashlib`.
        digest: hash of the file in hex, or its first digits.
        size: bytes of the file; None where not known.
        most: bytes that it has at most, where its size is not known.
    """

    url: str
    algorithm: str
    digest: str
    size: int | None = None
    most: int = UNKNOWN_SIZE

    @property
    def host(self) -> str:
        """Name of the server."""
        return urlsplit(self.url).hostname or self.url


class _Cut(Exception):
    """The transfer ended before the file did; another attempt may go on from there."""


def fetch(remote: Remote, target: Path, progress: Callable[[int, int | None], None]) -> None:
    """Download a file to ``target``, which appears whole and checked, or not at all.

    What has arrived lies in ``target`` + ".part" until then; the next call continues it where the server
    offers ranges, and starts again where it does not.

    Args:
        remote: the file.
        target: path of the file; its folder is made.
        progress: receives the bytes present and those of the whole file (None where not known).

    Raises:
        DataError: no network, no such file, no space, a cut connection, a wrong size or a wrong hash.
    """
    from filelock import FileLock, Timeout

    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(target.with_name(f"{target.name}.lock"), timeout=0) as lock:
            try:
                _fetch(remote, part, progress)
                os.replace(part, target)
            finally:
                Path(lock.lock_file).unlink(missing_ok=True)
    except Timeout:
        raise DataError(
            target, "is being fetched by another process", "Wait for it, or end that process"
        ) from None
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _no_space(target, error.strerror or "") from error
        raise DataError(
            target, f"cannot be written ({error.strerror or error})", "Name another folder"
        ) from error


def _fetch(remote: Remote, part: Path, progress: Callable[[int, int | None], None]) -> None:
    """Bring ``part`` to the whole, checked file."""
    resumed = part.exists()
    _transfer(remote, part, progress)
    if resumed and not _digest(remote, part).startswith(remote.digest):
        part.unlink()  # what an earlier call left may be of another file; this one decides
        _transfer(remote, part, progress)
    digest = _digest(remote, part)
    if not digest.startswith(remote.digest):
        part.unlink()
        kind = remote.algorithm.upper()
        raise DataError(
            remote.url,
            f"its {kind} is {digest[:12]}..., not {remote.digest[:12]}...: it is another file or was changed",
            "Nothing was kept. Try again; if it stays so, get the file elsewhere",
        )


def _digest(remote: Remote, part: Path) -> str:
    with part.open("rb") as file:
        return hashlib.file_digest(file, remote.algorithm).hexdigest()


def _transfer(remote: Remote, part: Path, progress: Callable[[int, int | None], None]) -> None:
    """Attempts with pauses between them, each from where the last one ended."""
    import requests

    answered = False
    with requests.Session() as session:
        for pause in (*PAUSES, None):
            try:
                with _request(session, remote, part) as response:
                    answered = True
                    _receive(response, remote, part, progress)
                return
            except (_Cut, requests.RequestException) as error:
                if not answered:
                    raise _unreachable(remote, error) from error
                if pause is None:
                    kept = part.stat().st_size if part.exists() else 0
                    why = error if isinstance(error, _Cut) else "no connection"
                    reason = f"{len(PAUSES) + 1} attempts failed, the last one: {why}; {kept} bytes are kept"
                    raise DataError(remote.url, reason, _REMEDY) from error
                time.sleep(pause)


def _request(session: Any, remote: Remote, part: Path) -> Response:
    """Ask for what is missing. Compression on the way would make ranges and sizes ambiguous."""
    headers = {"Accept-Encoding": "identity"}
    if part.exists() and (size := part.stat().st_size):
        headers["Range"] = f"bytes={size}-"
    # In a thread: the limit is one of the pause between bytes, and redirects and headers may have many.
    answers: queue.SimpleQueue[Response | Exception] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answers.put(session.get(remote.url, headers=headers, stream=True, timeout=TIMEOUT))
        except Exception as error:
            answers.put(error)

    threading.Thread(target=ask, daemon=True).start()
    try:
        answer = answers.get(timeout=WINDOW)
    except queue.Empty:
        raise _Cut(f"no whole answer within {WINDOW:g} s") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _receive(
    response: Response, remote: Remote, part: Path, progress: Callable[[int, int | None], None]
) -> None:
    """Append an answer's bytes to ``part``.

    Raises:
        _Cut: bytes are missing.
    """
    from urllib3.exceptions import HTTPError

    start, total = _extent(response, remote, part)
    if start and start == total:
        return
    if remote.size is not None and total not in (None, remote.size):
        raise _wrong_size(remote, f"the server has {total} bytes, the file has {remote.size}")
    whole = total if total is not None else remote.size
    most = whole if whole is not None else remote.most
    if most > (remote.size if remote.size is not None else remote.most):
        raise _wrong_size(remote, f"the server has {total} bytes, the file at most {remote.most}")
    free = shutil.disk_usage(part.parent).free
    if whole is not None and whole - start > free:
        raise _no_space(part.parent, f"{whole - start} bytes are missing, {free} are free")
    try:
        with part.open("r+b" if start else "wb") as file:
            file.truncate(start)
            file.seek(start)
            present = start
            progress(present, whole)
            window, before = time.monotonic(), present
            while chunk := response.raw.read1(_CHUNK, decode_content=False):
                file.write(chunk)
                present += len(chunk)
                if present > most:
                    part.unlink()
                    raise _wrong_size(remote, f"the server sends more than {most} bytes")
                progress(present, whole)
                if (seconds := time.monotonic() - window) > WINDOW:
                    if present - before < LEAST_RATE * seconds:
                        raise _Cut(f"{present - before} bytes within {seconds:.0f} s")
                    window, before = time.monotonic(), present
    except HTTPError as error:
        raise _Cut(type(error).__name__) from error
    if whole is not None and present < whole:
        raise _Cut(f"{present} of {whole} bytes arrived")


def _extent(response: Response, remote: Remote, part: Path) -> tuple[int, int | None]:
    """Where an answer's first byte belongs, and the bytes of the whole file; None where not known.

    Raises:
        _Cut: nothing usable arrived, and asking again may help.
        DataError: there is no such file.
    """
    code = response.status_code
    length = response.headers.get("Content-Length", "")
    if code == HTTPStatus.OK:  # whatever range was asked for
        return 0, int(length) if length.isdecimal() else None
    ranges = re.fullmatch(
        r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", response.headers.get("Content-Range", "").strip()
    )
    first, size = ranges.groups() if ranges else (None, None)
    have = part.stat().st_size if part.exists() else 0
    total = int(size) if size and size.isdecimal() else None
    if code == HTTPStatus.PARTIAL_CONTENT and first is not None and int(first) == have:
        return have, total
    if code in (HTTPStatus.PARTIAL_CONTENT, HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE):
        if code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and total == have:
            return have, total  # nothing of the file is missing
        part.unlink(missing_ok=True)
        raise _Cut(f"the server cannot continue at byte {have}")
    text = f"the server answers {code}"
    with suppress(ValueError):
        text += f" ({HTTPStatus(code).phrase})"
    if code >= 500 or code == HTTPStatus.TOO_MANY_REQUESTS:
        raise _Cut(text)
    raise DataError(remote.url, text, "The file may have moved: get it elsewhere")


def _unreachable(remote: Remote, error: Exception) -> DataError:
    import requests

    if isinstance(error, requests.exceptions.SSLError):
        return DataError(remote.url, "its certificate is not accepted", "Check the clock and the proxy")
    if not isinstance(error, requests.ConnectionError | requests.Timeout):
        return DataError(remote.url, f"cannot be asked for ({error})", "Correct the address")
    cause = "it does not answer" if isinstance(error, requests.Timeout) else "no connection"
    reason = f"{remote.host} cannot be reached ({cause})"
    return DataError(remote.url, reason, "Check the network (HTTPS_PROXY names a proxy) and run it again")


def _wrong_size(remote: Remote, text: str) -> DataError:
    return DataError(remote.url, text, "It is another file: get it elsewhere")


def _no_space(place: Path, text: str) -> DataError:
    return DataError(place, f"the disk is full ({text})", f"Free some, or name another folder. {_REMEDY}")
