"""What the number of a job was measured on: content of the scenes, and the very pictures.

A dataset's name is a label. Two jobs have one truth where content, edit, stress, split, views and their size
are the same, and where the renderers of their pictures agree (:func:`disagreeing`).
"""

from __future__ import annotations

import base64
import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.jobs.measure import Measure, MeasureResult
from econgs_bench.bench.jobs.truth import renderer_of
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Record
from econgs_bench.bench.suites.stress import part_of
from econgs_bench.datasets.hashes import hash_of

if TYPE_CHECKING:
    pass

TOLERANCE = 1e-3
"""Largest difference of two sketches whose pictures count as equal: a quarter of a step of 8 bits."""


def truth(record: Record, lineage: Lineage) -> str | None:
    """Identity of the pictures that a measurement compares with, and of its views; None if not known."""
    job = record.job
    measured = record.of(MeasureResult)
    if measured is None:
        return None
    known = lineage.contents(record) or {}
    parts = [known.get(job.subject)] if job.subject in known else [known.get(scene) for scene in job.scenes]
    request = job.request
    views: Any = job.identity.get("views")  # without its record, all that is known of a views job is its key
    if None not in parts:
        stress = part_of(job.stress, "truth", "test")
        size = [request.width, request.height, request.test_views]
        if request.samples != 1:
            size.append(request.samples)
        held_out = request.train_views if job.split == "val" else None
        views = [parts, job.edit, stress, job.split, size, held_out]
    if views is None:
        return None
    names = hash_of([view.view for view in measured.views])
    return f"{hash_of(views)}-{names[:8]}"


def renderer(record: Record, lineage: Lineage) -> str | None:
    """What rendered the pictures of a measurement, as "mitsuba 3.9.1 llvm"; None where not known."""
    measured = record.of(MeasureResult)
    if measured is not None and measured.renderer:
        return measured.renderer
    for one in lineage.needed(record, "views"):
        if (views := one.of(ViewsResult)) is not None:
            return renderer_of(views.cost.get(record.job.split))
    return None


def _values(text: str) -> NDArray[np.float64]:
    return np.frombuffer(base64.b64decode(text), "<u2").astype(np.float64) / 65535


def disagreeing(lineage: Lineage) -> dict[str, str]:
    """Job of a measurement -> a mark of its pictures, where they differ from most others of its truth.

    Records without a sketch count as measured on the pictures of most.
    """
    sketches: dict[str, dict[str, str]] = defaultdict(dict)
    for record in lineage:
        measured = record.of(MeasureResult)
        if measured is not None and measured.sketch:
            key = truth(record, lineage)
            if key is not None:
                sketches[key][record.job.id] = measured.sketch
    marks = {}
    for own in sketches.values():
        usual = Counter(own.values()).most_common(1)[0][0]
        for job, text in own.items():
            if text != usual and not _agree(text, usual):
                marks[job] = hash_of(text)
    return marks


def _agree(first: str, second: str) -> bool:
    a, b = _values(first), _values(second)
    return a.shape == b.shape and float(np.abs(a - b).max(initial=0.0)) <= TOLERANCE


def metric_versions(record: Record) -> dict[str, str]:
    """Metric -> version of a measurement; what older records do not name has version 1."""
    from econgs_bench.reports.schema import COVERAGE

    if not isinstance(record.job, Measure):
        return {}
    return dict.fromkeys(COVERAGE, "1") | record.job.metrics


def axes(record: Record, lineage: Lineage, marks: Mapping[str, str]) -> dict[str, Any]:
    """The columns of the table `jobs` that identify what a job is measured on and by.

    Args:
        record: of the job.
        lineage: of its store.
        marks: of :func:`disagreeing`.
    """
    known, key = lineage.contents(record), truth(record, lineage)
    mark = marks.get(record.job.id)
    versions, measured = metric_versions(record), record.of(MeasureResult)
    return {
        "contents": json.dumps(known, sort_keys=True) if known else None,
        "truth": f"{mark}{key[len(mark) :]}" if key is not None and mark else key,
        "renderer": renderer(record, lineage) if record.job.kind == "measure" else None,
        "test_views": len(measured.views) if measured is not None else None,
        "metric_versions": json.dumps(versions, sort_keys=True) if versions else None,
    }
