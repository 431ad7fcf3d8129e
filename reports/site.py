"""A static site of submissions: what they show together, and a page per dataset, method and submission.

Results are of two divisions. *Closed*: views, budget and options as a preset gives them, so that methods
compare. *Open*: anything else.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.clocks import Clocks
from econgs_bench.reports.comparability import judged
from econgs_bench.reports.files import file_name, write_text
from econgs_bench.reports.page.document import document, write_report
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.order import family, first
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import TITLES, counted
from econgs_bench.reports.tables.documents import to_json
from econgs_bench.reports.tables.table import html_table
from econgs_bench.reports.text import xml_text

if TYPE_CHECKING:
    import pandas as pd

HISTORY = "submissions.json"
CLOSED, OPEN = "closed", "open"
_GIVEN = {"configuration", "samples"}
"""Settings that the closed division leaves free: the published or this project's, rays of a drawn pixel."""


@dataclass(frozen=True)
class Submission:
    """A bundle that was verified.

    Attributes:
        name: of the file, without its ending.
        sha256: of the file.
        added: when it came to the site, UTC.
        records: number of its jobs.
        redone: number of its models that were decoded and measured again here.
        first, last: when its first and last job ended.
        machines, commits, methods, datasets: names.
        seeds: numbers.
    """

    name: str
    sha256: str
    added: str
    records: int
    redone: int
    first: str
    last: str
    machines: tuple[str, ...]
    commits: tuple[str, ...]
    seeds: tuple[int, ...]
    methods: tuple[str, ...]
    datasets: tuple[str, ...]

    @property
    def place(self) -> str:
        """Its folder: another file of the same name has another."""
        return f"submissions/{file_name(self.name)}-{self.sha256[:8]}"


def with_division(results: pd.DataFrame, views: Mapping[str, int]) -> pd.DataFrame:
    """Results with the column ``division``.

    Args:
        results: the table `results`.
        views: preset -> training views that it gives.
    """

    def of(row: Mapping[Any, Any]) -> str:
        set_here = json.loads(row["options"]) if isinstance(row["options"], str) and row["options"] else {}
        given = (
            set(set_here) <= _GIVEN
            and row["split"] == "test"
            and views.get(row["preset"]) == row["requested_views"]
        )
        return CLOSED if given else OPEN

    return results.assign(division=[of(row) for row in results.to_dict("records")])


def write_site(
    out: Path,
    title: str,
    tables: dict[str, pd.DataFrame],
    submissions: Sequence[tuple[Submission, dict[str, pd.DataFrame]]],
    views: Mapping[str, int],
) -> Path:
    """Write the pages; the index comes last, so that its links lead to pages that are there.

    Args:
        out: folder of the site. Submissions that it had before stay, in pages and in the history.
        title: of the index.
        tables: of all submissions together.
        submissions: each with its own tables.
        views: as of :func:`with_division`.

    Returns:
        The index.
    """
    history = _history(out, [one for one, _ in submissions])
    for one, own in submissions:
        _report(out / one.place, own, views)
    results = with_division(tables["results"], views)
    parts = {
        kind: [(str(name), _of(tables, kind, name)) for name in results[kind].dropna().unique()]
        for kind in ("dataset", "method")
    }
    for kind, pages in parts.items():
        for name, own in pages:
            _report(out / _place(kind, name), own, views)
    chosen = tables["results"][results["division"] == CLOSED]
    closed = {**tables, "results": judged(chosen, Clocks(tables["results"]))}
    report = Report(closed)
    answers = first(Page(report, family(report)))
    sections = [
        *([answers] if answers is not None else []),
        Section("divisions", "Divisions", words=_WORDS),
        *(_index(kind, [name for name, _ in pages], results) for kind, pages in parts.items()),
        _submissions(history),
    ]
    links = "".join(f'<li><a href="#{each.anchor}">{escape(each.title)}</a></li>' for each in sections)
    head = (
        f'<h1>{escape(title)}</h1><button type="button" id="theme" hidden></button>'
        f"<p>{counted(len(history), 'submission')}, {counted(len(results), 'result')}.</p>"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>'
    )
    write_text(out / HISTORY, json.dumps(history, indent=1) + "\n")
    index = out / "index.html"
    write_text(index, xml_text(document(title, head, sections, folded=False)))
    return index


_WORDS = (
    "Closed: views, budget and options are those of a preset; the answers above are of these results alone. "
    "Open: anything else, as other options, schedules or views. The column division of results.json tells "
    "which. Stale rows were made by versions or options that are no longer today's. Every bundle was checked "
    "by bench verify before it came here; the table of submissions says how many of its models were decoded "
    "and measured again."
)


def _history(out: Path, submissions: Sequence[Submission]) -> list[dict[str, Any]]:
    """All submissions that the site ever had, in the order in which they came; each stays as it was."""
    path = out / HISTORY
    history: list[dict[str, Any]] = json.loads(path.read_text("utf-8")) if path.exists() else []
    places = {one["sha256"]: i for i, one in enumerate(history)}
    for one in submissions:
        values = {**asdict(one), "place": one.place}
        if one.sha256 not in places:
            history.append(values)
        else:
            old = history[places[one.sha256]]
            old["redone"] = max(int(old["redone"]), one.redone)
    return history


def _of(tables: Mapping[str, pd.DataFrame], column: str, value: Any) -> dict[str, pd.DataFrame]:
    """The rows of one dataset or method."""
    return {
        name: table[table[column] == value] if column in table else table for name, table in tables.items()
    }


def _place(kind: str, name: str) -> str:
    return f"{kind}s/{file_name(name)}"


def _report(folder: Path, tables: dict[str, pd.DataFrame], views: Mapping[str, int]) -> None:
    """A report without pictures, and its results as JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = with_division(tables["results"], views)
    write_text(folder / "results.json", to_json(rows))
    write_report(tables, folder, folder / "index.html")


def _index(kind: str, names: Sequence[str], results: pd.DataFrame) -> Section:
    """Datasets with their methods, or methods with their datasets, and how many results of each division."""
    other = {"dataset": "method", "method": "dataset"}[kind]
    lines = []
    for name in names:
        rows = results[results[kind] == name]
        title = TITLES.get(name, name) if kind == "method" else name
        others = [TITLES.get(str(each), str(each)) for each in rows[other].dropna().unique()]
        place = _place(kind, name)
        counts = [str(int((rows["division"] == division).sum())) for division in (CLOSED, OPEN)]
        lines.append(
            [
                f'<a href="{place}/index.html">{escape(title)}</a>',
                f'<span class="wrap">{escape(", ".join(others))}</span>',
                *counts,
                f'<a href="{place}/results.json">JSON</a>',
            ]
        )
    heads = [kind.capitalize(), f"{other.capitalize()}s", "Closed", "Open", "Data"]
    table = html_table(f"Results by {kind}", heads, lines, [False, False, True, True, False])
    return Section(f"{kind}s", f"{kind.capitalize()}s", html=table)


def _submissions(history: Sequence[Mapping[str, Any]]) -> Section:
    """Every submission, the newest first; an earlier one of the same name stays and is called so."""
    newest = {one["name"]: one["sha256"] for one in history}
    lines = []
    for one in reversed(history):
        state = "verified" + (f", {one['redone']} models measured again" if one["redone"] else "")
        if newest[one["name"]] != one["sha256"]:
            state += "; replaced by a later one"
        cells = (
            one["added"][:10], f"{one['first'][:10]} to {one['last'][:10]}", ", ".join(one["machines"]),
            ", ".join(each[:12] for each in one["commits"]), ", ".join(map(str, one["seeds"])),
            str(one["records"]), state, one["sha256"][:12],
        )  # fmt: skip
        link = f'<a href="{one["place"]}/index.html">{escape(one["name"])}</a>'
        lines.append([link, *(f'<span class="wrap">{escape(cell)}</span>' for cell in cells)])
    heads = ["Submission", "Added", "Measured", "Machine", "Commit", "Seeds", "Records", "Checked", "SHA-256"]
    return Section("submissions", "Submissions", html=html_table("Submissions, newest first", heads, lines))
