"""Standard output and error of a command: any encoding, closed or broken, and labels that are data.

Signs that the encoding lacks are replaced; control characters are escaped; and once the reader is gone (a
closed pipe, a full disk) the rest is dropped, so that a command still writes its files and ends with its own
exit code, or :data:`LOST`.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from econgs_bench.reports.text import one_line, printable

LOST = 141
"""Exit code of a command that did its work but whose output could not be written: that of SIGPIPE."""


class Stream:
    """A text stream in the place of ``sys.stdout`` or ``sys.stderr``; all else is the stream's own.

    Attributes:
        lost: whether something could not be written.
        written: when something was written last, by the monotonic clock.
        styled: the stream for writers that send commands to the terminal on purpose (rich).

    Args:
        stream: where it writes.
        before: called before each writing.
    """

    def __init__(self, stream: TextIO, before: Callable[[], None] = lambda: None) -> None:
        self._stream, self._before = stream, before
        self.lost = False
        self.written = time.monotonic()
        self.styled = _Styled(self)

    def write(self, text: str) -> int:
        self.write_raw(printable(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def write_raw(self, text: str) -> None:
        """Write control characters as they are."""
        self._before()
        self.written = time.monotonic()
        encoding = self._stream.encoding or "utf-8"
        with self._noticed():
            self._stream.write(text.encode(encoding, "replace").decode(encoding))

    def flush(self) -> None:
        with self._noticed():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextmanager
    def _noticed(self) -> Iterator[None]:
        """Notice that nobody reads; what the stream still holds then goes nowhere, also at Python's end."""
        try:
            yield
        except OSError:
            self.lost = True
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


class _Styled:
    """A :class:`Stream` that leaves control characters as they are."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write_raw(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Closed(io.TextIOBase):
    """The stream of a descriptor that was closed before Python began."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))


class Terminal:
    """The standard streams of a command.

    Attributes:
        streams: output and error.
        live: whether errors go to a terminal that can take a line back.
    """

    def __init__(self) -> None:
        out, err = sys.stdout or _closed(1), sys.stderr or _closed(2)
        self._err, self._lock, self._shown = err, threading.RLock(), False
        self.streams = [Stream(out, self._clear), Stream(err, self._clear)]
        self.live = err.isatty() and os.environ.get("TERM") != "dumb"

    @property
    def written(self) -> float:
        """When something was written last that stays, by the monotonic clock."""
        return max(stream.written for stream in self.streams)

    def transient(self, line: str) -> None:
        """Show a line on the terminal until something else is written, or the next one; "" takes it back."""
        with self._lock, suppress(OSError):
            if not self.live or not (line or self._shown):
                return
            cut = one_line(line)[: shutil.get_terminal_size().columns - 1]
            encoding = self._err.encoding or "utf-8"
            self._err.write("\r\x1b[2K" + cut.encode(encoding, "replace").decode(encoding))
            self._err.flush()
            self._shown = bool(line)

    def _clear(self) -> None:
        if self._shown:
            self.transient("")

    def flush(self) -> None:
        for stream in self.streams:
            stream.flush()

    def code(self, code: int) -> int:
        """The exit code of a command that ended with ``code``: :data:`LOST` where 0 would hide a loss."""
        return LOST if code == 0 and any(stream.lost for stream in self.streams) else code


@contextmanager
def terminal() -> Iterator[Terminal]:
    """Print through a :class:`Terminal` for as long as the context lasts."""
    before = sys.stdout, sys.stderr
    state = Terminal()
    sys.stdout, sys.stderr = (cast(TextIO, stream) for stream in state.streams)
    try:
        yield state
    except SystemExit as end:  # of argparse, which has printed a help or a version
        state.flush()
        raise SystemExit(end.code or state.code(0)) from None
    finally:
        state.flush()
        sys.stdout, sys.stderr = before


def _closed(number: int) -> TextIO:
    """A stream for a closed descriptor, which no file may take: children would print into that file."""
    opened = os.open(os.devnull, os.O_WRONLY)
    if opened != number:
        os.dup2(opened, number)
        os.close(opened)
    return cast(TextIO, _Closed())


def line_width() -> int:
    """Characters of a line of standard output: the terminal's, and 120 in a file or a pipe."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 120


def print_prose(text: str, out: TextIO | None = None) -> None:
    """Print sentences: on a terminal they wrap between words, below the text where they begin."""
    out = sys.stdout if out is None else out
    for line in text.split("\n"):
        if out.isatty() and len(line) > line_width():
            head = re.match(r"\S.{,30}?  +(?=\S)", line)  # a name before the sentence
            indent = " " * len(head[0] if head else "  ")
            line = textwrap.fill(
                line, line_width(), subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
            )
        print(line, file=out)


def console(name: str = "stdout", **options: Any) -> Any:
    """A console of rich on a standard stream, whose colors and live lines a terminal takes as commands.

    Args:
        name: "stdout" or "stderr".
        options: of ``rich.console.Console``.

    Labels that it prints pass :func:`.reports.text.one_line` first.
    """
    from rich.console import Console

    stream = getattr(sys, name)
    return Console(file=getattr(stream, "styled", stream), **options)
