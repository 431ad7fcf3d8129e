"""The models behind a report's rows, as pages beside it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.bench.saved import seen
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.bench.view.sent import Sent, part, sent
from econgs_bench.bench.view.sources import Opened, of_job, title_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    from econgs_bench.bench.store.records import Record

FOLDER = "models"


def page_of(store: Store, job: str, opened: Opened, scenes: Sequence[str]) -> Sent:
    """The page of scenes of a job's model.

    Raises:
        DataError: it does not consist of Gaussians, or the store lacks its training views.
    """
    parts = []
    for scene in scenes:
        step(f"reading the Gaussians of {scene}")
        parts.append(part(opened, scene, *seen(store, job, scene)[:2]))
    return sent(opened, title_of(store, job), parts)


def write_pages(
    store: Store, jobs: Iterable[str], folder: Path, plugins: Sequence[str] = (), device: str = "cpu"
) -> dict[str, Path]:
    """Write a page for the model of each measure job; one that is newer than its model is kept.

    Args:
        store: holds the models.
        jobs: measure jobs; several may have one model.
        folder: of the report; the pages go into a folder inside.
        plugins: folders of methods.
        device: of the methods.

    Returns:
        Job -> page. Models that do not consist of Gaussians, of several groups, or that the store lacks,
        have none; a line on standard error counts them.
    """
    rows: dict[str, list[str]] = {}
    for job in jobs:
        encodes = [need for need in _record(store, job).job.needs if need.startswith("encode-")]
        if len(encodes) == 1:
            rows.setdefault(encodes[0], []).append(job)
    pages: dict[str, Path] = {}
    reasons: list[str] = []
    for done, (encode, measured) in enumerate(rows.items()):
        step("writing pages of models", done, len(rows))
        page = folder / FOLDER / f"{encode}.html"
        try:
            if not _is_newer(page, store.jobs / encode / "record.json"):
                opened = of_job(store, encode, plugins, device)
                text = page_of(store, encode, opened, opened.scenes).text
                page.parent.mkdir(parents=True, exist_ok=True)
                write_text(page, text)
        except DataError as error:
            reasons.append(str(error))
            continue
        pages |= dict.fromkeys(measured, page)
    if reasons:
        count = f"{len(reasons)} of {len(rows)} models have no page"
        print(f"bench: {count}; the first: {reasons[0]}", file=sys.stderr)
    return pages


def _record(store: Store, job: str) -> Record:
    record = store.record(job)
    assert record is not None, job
    return record


def _is_newer(page: Path, record: Path) -> bool:
    return page.is_file() and page.stat().st_mtime > record.stat().st_mtime
