"""What a command does while it is silent: one line on a terminal, a line now and then elsewhere.

Commands name their steps (:func:`step`); whatever takes long shows as the last step that was named.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from econgs_bench.reports.terminal import Terminal
from econgs_bench.reports.text import one_line

SILENCE, RAREST = 10.0, 80.0
"""Seconds of one step without output after which a line is due, first and in the end."""
_TERMINAL_SILENCE = 1.0

_watches: list[Watch] = []


def step(text: str, done: int = 0, total: int = 0) -> None:
    """Name what the command does from now on, and how much of it is done."""
    for watch in _watches:
        watch.step(text, done, total)


@contextmanager
def hushed() -> Iterator[None]:
    """Show nothing: what follows has a display of its own."""
    watches, _watches[:] = _watches[:], []
    for watch in watches:
        watch.hush(True)
    try:
        yield
    finally:
        _watches[:] = watches
        for watch in watches:
            watch.hush(False)


@contextmanager
def watched(streams: Terminal, command: str) -> Iterator[None]:
    """Show on standard error what a command does when it prints nothing for a while.

    Args:
        streams: those that the command prints to.
        command: its name, the first step.
    """
    watch = Watch(streams, command)
    ended = threading.Event()

    def beats() -> None:
        while not ended.wait(1.0):
            watch.beat(time.monotonic())

    thread = threading.Thread(target=beats, daemon=True)
    _watches.append(watch)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        _watches.remove(watch)
        streams.transient("")


class Watch:
    """The line of a command."""

    def __init__(self, streams: Terminal, command: str) -> None:
        self._streams, self._hushed = streams, False
        self._text = ""
        self.step(command)

    def step(self, text: str, done: int = 0, total: int = 0) -> None:
        """Name what is done from now on; its clock starts where the text is another."""
        if text != self._text:
            self._text, self._begun, self._lines = text, time.monotonic(), 0
        self._done, self._total = done, total

    def hush(self, silent: bool) -> None:
        """Show nothing, or go on."""
        self._hushed = silent
        self._streams.transient("")

    def beat(self, now: float) -> None:
        """Show the line if it is due."""
        silent = now - max(self._streams.written, self._begun)
        spent = now - self._begun
        line = f"bench: {one_line(self._text)}"
        if self._total:
            line += f", {self._done} of {self._total}"
        line += f", {spent:.0f} s"
        if 0 < self._done < self._total:
            line += f", {spent * (self._total - self._done) / self._done:.0f} s left"
        if self._hushed:
            return
        if self._streams.live:
            if silent >= _TERMINAL_SILENCE:
                self._streams.transient(line)
        elif silent >= min(SILENCE * 2**self._lines, RAREST):
            self._lines += 1
            self._streams.streams[1].write(f"{line}\n")
            self._streams.streams[1].flush()
