"""Near matches for unknown names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from econgs_bench.datasets.errors import UnknownName


def unknown(kind: str, name: str, candidates: Iterable[str], *, of: str = "", hint: str = "") -> UnknownName:
    """Error for an unknown name; the remedy holds near matches, else all candidates and the hint."""
    names = sorted(candidates)
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    where = f" of {of}" if of else ""
    known = f"Known: {', '.join(names) or 'none'}" + (f"; {hint}" if hint else "")
    remedy = f"Did you mean {', '.join(near)}?" if near else known
    return UnknownName(f"{kind} {name!r}{where}", "unknown name", remedy)
