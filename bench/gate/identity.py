"""What the results of a cell were measured on and by, and why those of two cells are not compared."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

from econgs_bench.reports.comparability import pair_differences
from econgs_bench.reports.style import absent

CONTENTS, TRUTH, RENDERER = "contents", "truth", "renderer"
"""Kinds of differences beside those of single quantities, which have the quantity's name."""
_FRAMES = "frame_ratio"


class Identity(BaseModel):
    """Identity of a cell's truth, metrics and clock; what a record does not state is None or missing.

    Attributes:
        contents: scene -> hash of its definition and data.
        truth: hash of what the pictures of the truth show: contents, edit, views and their size.
        renderer: what rendered them.
        metric_versions: metric -> version.
        ruler: version of how frames are timed.
    """

    model_config = ConfigDict(extra="forbid")
    contents: dict[str, str] = {}
    truth: str | None = None
    renderer: str | None = None
    metric_versions: dict[str, str] = {}
    ruler: str | None = None

    @classmethod
    def of(cls, row: Mapping[Any, Any]) -> Identity:
        """That of a row of `results`."""
        values = {name: None if absent(row.get(name)) else str(row[name]) for name in cls.model_fields}
        tables = {name: json.loads(values.pop(name) or "{}") for name in ("contents", "metric_versions")}
        return cls(**tables, **values)  # type: ignore[arg-type]


def differences(old: Identity, new: Identity) -> dict[str, str]:
    """Kind -> why a baseline's identity and a run's do not compare (:mod:`.reports.comparability`)."""
    found = pair_differences(old.model_dump(), new.model_dump())
    return {_FRAMES if kind == "ruler" else kind: reason for kind, reason in found.items()}
