"""What a job leaves in its folder while it runs: its states and its log."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from econgs_bench.datasets.errors import printable

_TAIL = 40


def log_tail(folder: Path) -> str | None:
    """The last lines of a job's log."""
    sys.stdout.flush()
    sys.stderr.flush()
    try:
        with (folder / "log.txt").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 16_384))
            text = file.read().decode(errors="replace")
    except OSError:
        return None
    return printable("\n".join(text.splitlines()[-_TAIL:])) or None


def read_progress(folder: Path, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """The whole states in ``progress.jsonl`` from a byte offset on, and the offset of the next one."""
    try:
        with (folder / "progress.jsonl").open("rb") as file:
            file.seek(offset)
            lines = file.read().splitlines(keepends=True)
    except OSError:
        return [], offset
    if lines and not lines[-1].endswith(b"\n"):
        lines.pop()
    states = []
    for line in lines:
        with suppress(ValueError):  # cut off by a kill, and continued by a later attempt
            state = json.loads(line)
            if isinstance(state, dict) and isinstance(state.get("time"), int | float):
                states.append(state)
    return states, offset + sum(map(len, lines))


def traces(folder: Path) -> dict[str, Any]:
    """Where a job failed: fields of its record."""
    states, _ = read_progress(folder)
    last = states[-1] if states else {}
    return {"stage": last.get("stage"), "iteration": last.get("iteration"), "log_tail": log_tail(folder)}


def now() -> str:
    """Time in UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
