"""Pieces of HTML that several sections of the page share."""

from __future__ import annotations

import json
from html import escape
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.style import PALETTE, Look, Model, absent, look, model, row_label

if TYPE_CHECKING:
    from collections.abc import Sequence


def method(row: Any, models: Sequence[Model]) -> str:
    """A row's method with variant and rate, after its marker in the charts."""
    mark = dot(look(model(row["method"], row["variant"]), models))
    name = escape(row_label(row))
    for after in ",=":
        name = name.replace(after, f"{after}<wbr>")
    return f"{mark}{name}"


def dot(look: Look) -> str:
    """A marker in its color; the page's style has its shape, and the colors of methods."""
    if look.color in PALETTE:
        return f'<i class="dot {look.marker} c{PALETTE.index(look.color)}"></i>'
    return f'<i class="dot {look.marker}" style="background:{look.color}"></i>'


def status(row: Any) -> str:
    """Tags with a row's status and, if it is stale, with that."""
    state = str(row["status"])
    why = "" if state == "ok" or absent(row["reason"]) else f' title="{escape(str(row["reason"]))}"'
    tag = f'<span class="tag {"ok" if state == "ok" else "bad"}"{why}>{escape(state)}</span>'
    if not absent(row["stale"]) and row["stale"]:
        tag += f" {stale(row['changes'])}"
    return tag


def stale(changes: Any) -> str:
    """Tag of a row that would be another today, with what changed."""
    title = "" if absent(changes) else f' title="{escape(str(changes))}"'
    return f'<span class="tag stale"{title}>stale</span>'


def data(value: Any, anchor: str = "") -> str:
    """A value for the page's script, as JSON in which no text can end or open an element.

    Args:
        value: anything that JSON holds.
        anchor: id of the element.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    name = f' id="{anchor}"' if anchor else ""
    return f'<script type="application/json"{name}>{text}</script>'


def hint(text: str, why: str) -> str:
    """A text with an explanation."""
    return f'<abbr title="{escape(str(why))}">{escape(text)}</abbr>'
