"""Progress of a run on standard error: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any

from econgs_bench.bench.store.records import Job, Record
from econgs_bench.reports.text import one_line

PLAIN_SECONDS = 10.0
_CLOCK = 12
"""Width of the live line's spinner and clock."""


def make_display() -> Display:
    """The display that fits standard error."""
    return LiveDisplay() if sys.stderr.isatty() else Display()


class Display:
    """Progress as lines on standard error: begin and end of each job, and a state now and then."""

    def __init__(self) -> None:
        self._begun: dict[str, tuple[str, float]] = {}
        self._printed = 0.0

    def note(self, text: str) -> None:
        """Show a line that concerns the whole run."""
        self._print(f"bench: {text}")

    def begin(self, job: Job, number: int, total: str) -> None:
        """Show that a job begins, the ``number``-th of ``total``: "13", or "13+" for at least as many."""
        self._printed = time.monotonic()
        prefix = f"[{number}/{total}]"
        self._begun[job.id] = prefix, self._printed
        self._print(f"{prefix} {job.title}")

    def state(self, job: Job, state: dict[str, Any]) -> None:
        if state.get("waiting") or time.monotonic() - self._printed >= PLAIN_SECONDS:
            self._printed = time.monotonic()
            self._print(f"{self._begun[job.id][0]}   {describe(state)}")

    def end(self, job: Job, record: Record | None, note: str = "") -> None:
        prefix, start = self._begun.pop(job.id)
        self._print(f"{prefix}   {ending(record, note)} after {time.monotonic() - start:.1f} s")

    def _print(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)


class Silence(Display):
    """No progress at all."""

    def _print(self, line: str) -> None:
        pass


class LiveDisplay(Display):
    """One live line per running job (rich), a line that stays for each finished one."""

    def __init__(self) -> None:
        from econgs_bench.reports.terminal import console

        super().__init__()
        self._console = console("stderr")
        self._live: Any = None
        self._lines: dict[str, Any] = {}

    def note(self, text: str) -> None:
        self._console.print(f"bench: {one_line(text)}", highlight=False, markup=False)

    def begin(self, job: Job, number: int, total: str) -> None:
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.table import Column

        if not self._begun:
            text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True))
            columns = (SpinnerColumn(), TimeElapsedColumn(), text)
            self._live = Progress(*columns, console=self._console, transient=True)
            self._live.start()
        title = one_line(f"{number}/{total} {job.title}")
        self._begun[job.id] = title, time.monotonic()
        self._lines[job.id] = self._live.add_task(title, total=None)

    def state(self, job: Job, state: dict[str, Any]) -> None:
        line = status_line(self._begun[job.id][0], state, self._console.width - _CLOCK)
        self._live.update(self._lines[job.id], description=one_line(line))

    def end(self, job: Job, record: Record | None, note: str = "") -> None:
        title, start = self._begun.pop(job.id)
        self._live.remove_task(self._lines.pop(job.id))
        if not self._begun:
            self._live.stop()
        color = "green" if record is not None and record.ok else "yellow" if record is None else "red"
        self._console.print(title, style="bold", end=": ", highlight=False, markup=False)
        self._console.print(
            f"{one_line(ending(record, note))}, {time.monotonic() - start:.1f} s",
            style=color,
            highlight=False,
            markup=False,
        )


def status_line(title: str, state: dict[str, Any], width: int) -> str:
    """A job and its state in at most ``width`` characters: what has no room yields, losses first.

    Most important first: title, share done, time left, PSNR, stage, primitives, loss and its parts.
    """
    parts = []
    if state.get("iteration") is not None and state.get("iterations"):
        parts.append(f"{100 * state['iteration'] // state['iterations']} %")
    if state.get("left") is not None:
        parts.append(f"{span(state['left'])} left")
    if state.get("psnr") is not None:
        parts.append(f"{state['psnr']:.2f} dB")
    parts.append(str(state.get("stage", "")))
    if state.get("primitives"):
        parts.append(f"{state['primitives']} primitives")
    if state.get("loss") is not None:
        parts.append(f"loss {state['loss']:.4f}")
        parts += [f"{name} {value:.3g}" for name, value in state.get("parts", {}).items() if value > 1e-6]
    room = width - sum(len(part) + 2 for part in parts[:3])
    line = title if len(title) <= room else f"{title[: max(0, room - 1)]}\N{HORIZONTAL ELLIPSIS}"
    for part in filter(None, parts):
        if len(line) + 2 + len(part) > width:
            break
        line += f", {part}"
    return line


def describe(state: dict[str, Any]) -> str:
    """Stage, iteration, loss, PSNR on validation views, primitives, time left: as far as counts."""
    parts = [str(state.get("stage", ""))]
    if state.get("iteration") is not None:
        parts.append(f"{state['iteration']}/{state.get('iterations', '?')}")
    if state.get("loss") is not None:
        terms = {name: value for name, value in state.get("parts", {}).items() if value > 1e-6}
        others = ", ".join(f"{name} {value:.3g}" for name, value in terms.items())
        parts.append(f"loss {state['loss']:.4f}" + (f" ({others})" if others else ""))
    if state.get("psnr") is not None:
        parts.append(f"{state['psnr']:.2f} dB")
    if state.get("primitives"):
        parts.append(f"{state['primitives']} primitives")
    if state.get("left") is not None:
        parts.append(f"{span(state['left'])} left")
    return ", ".join(part for part in parts if part)


def ending(record: Record | None, note: str) -> str:
    """How a job ended, in words."""
    if record is None:
        return note or "not finished"
    status = record.status if record.ok else f"{record.status} ({record.reason})"
    return f"{status}, {note}" if note else status


def span(seconds: float) -> str:
    """A duration for people: 8 s, 3:05 min, 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
