"""What the results of a cell were measured on and by, and why those of two cells are not compared."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

from reports.style import absent

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
    """Kind -> why two identities do not compare; what is unknown on one side differs in nothing.

    :data:`CONTENTS` and :data:`TRUTH` (other views of the same) hold for all results. Renderers of one truth
    agree but for rounding, so :data:`RENDERER` explains differences and forbids no comparison.
    """
    found = {}
    for scene in old.contents.keys() & new.contents.keys():
        if changed := _changed(old.contents[scene], new.contents[scene]):
            found[CONTENTS] = f"truth differs: content of {scene} {changed}"
    if CONTENTS not in found and (changed := _changed(old.truth, new.truth)):
        found[TRUTH] = f"truth differs: other views of the same content, {changed}"
    if changed := _changed(old.renderer, new.renderer):
        found[RENDERER] = f"the truth was rendered by {new.renderer}, the baseline's by {old.renderer}"
    if changed := _changed(old.ruler, new.ruler):
        found[_FRAMES] = f"version of how frames are timed {changed}"
    for name in old.metric_versions.keys() & new.metric_versions.keys():
        if changed := _changed(old.metric_versions[name], new.metric_versions[name]):
            found[name] = f"version of the metric {changed}"
    return found


def _changed(old: str | None, new: str | None) -> str:
    return "" if old is None or new is None or old == new else f"{old} → {new}"
