"""What a command does while it is silent, by a clock of the test's own."""

import io
import re
import time
from itertools import pairwise

import pytest

from econgs_bench.reports import progress
from econgs_bench.reports.progress import RAREST, SILENCE, Watch, hushed, step
from econgs_bench.reports.terminal import Terminal, terminal


class Screen(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def _screen(monkeypatch, term="xterm"):
    """A terminal in the place of standard error; pytest's own comes back between a fixture and its test."""
    monkeypatch.setenv("TERM", term)
    monkeypatch.setenv("COLUMNS", "40")
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    return screen


def test_a_pipe_gets_a_line_now_and_then(capsys):
    watch = Watch(Terminal(), "scenes")
    watch.step("reading a.nrrd", 1, 3)
    now, lines = time.monotonic(), []
    for second in range(400):
        before = watch._streams.written
        watch.beat(now + second)
        if watch._streams.written != before:
            watch._streams.streams[1].written = now + second  # as the clock of the test has it
        lines += [(second, line) for line in capsys.readouterr().err.splitlines()]
    begun = lines[0][0]
    assert lines[0][1] == f"bench: reading a.nrrd, 1 of 3, {begun} s, {2 * begun} s left"
    seconds = [second for second, _ in lines]
    assert seconds[0] == pytest.approx(SILENCE, abs=1)
    gaps = [after - before for before, after in pairwise(seconds)]
    assert gaps == sorted(gaps)
    assert gaps[-1] == pytest.approx(RAREST, abs=1)


def test_who_speaks_is_not_interrupted(capsys):
    streams = Terminal()
    watch = Watch(streams, "results")
    streams.streams[0].written = time.monotonic() + 100.0  # the command printed just now
    watch.beat(time.monotonic() + 100.0 + SILENCE - 1.0)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_the_line_until_something_is_printed(monkeypatch, capsys):
    screen = _screen(monkeypatch)
    streams = Terminal()
    watch = Watch(streams, "export")
    watch.step("writing\na file of a long name" + "x" * 50)
    watch.beat(time.monotonic() + 2.0)
    shown = screen.getvalue()
    assert shown.startswith("\r\x1b[2Kbench: writing\\na file of a long name")
    assert len(shown.removeprefix("\r\x1b[2K")) < 40
    streams.streams[0].write("done\n")
    assert screen.getvalue() == shown + "\r\x1b[2K"
    assert capsys.readouterr().out == "done\n"
    streams.streams[0].write("more\n")
    assert screen.getvalue() == shown + "\r\x1b[2K"


def test_a_run_with_its_own_display_is_left_alone(monkeypatch):
    screen = _screen(monkeypatch)
    with terminal() as streams, progress.watched(streams, "run"):
        (watch,) = progress._watches
        with hushed():
            step("nothing")
            watch.beat(time.monotonic() + 100.0)
            assert "nothing" not in screen.getvalue()
        step("tables")
        watch.beat(time.monotonic() + 100.0)
        assert re.search(r"bench: tables, 100 s$", screen.getvalue())
    assert screen.getvalue().endswith("\r\x1b[2K")
    assert progress._watches == []


def test_a_dumb_terminal_takes_no_commands(monkeypatch):
    screen = _screen(monkeypatch, "dumb")
    watch = Watch(Terminal(), "export")
    watch.beat(time.monotonic() + 2 * SILENCE)
    assert screen.getvalue() == "bench: export, 20 s\n"
