"""A section: the answer to a question with its charts and tables, and its renderings."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.chart import Chart, Panel
from econgs_bench.reports.family import Family
from econgs_bench.reports.style import Look
from econgs_bench.reports.tables import table as tables
from econgs_bench.reports.tables.table import Table
from econgs_bench.reports.text import markdown_cell

if TYPE_CHECKING:
    from econgs_bench.reports.report import Report

MOST_PANELS = 16
"""Panels of a section on the page."""
_WIDE = 600.0
"""Pixels from which a panel has a row of its own."""
_MOST_WIDE = 2
"""Such panels of a section on the page."""
MOST_DATASETS = 8
"""Datasets of a section with several charts on the page."""


@dataclass(frozen=True)
class Page:
    """What sections are made from.

    Attributes:
        report: the tables.
        family: all leads of the page, which are corrected together.
        paper: the paper's tables of the same rows (:mod:`.reports.sections.paper.tables`).
        root: folder that the paths of pictures are relative to.
        folder: folder beside the page, for the files of pictures; None where no pictures are wanted.
        anchors: of the sections that are made already.
        models: job of a row -> page of its model, relative to the report's.
        inside: such a page -> its content, gzipped, in base64, for a report that holds it.
    """

    report: Report
    family: Family
    paper: Sequence[Any] = ()
    root: Path = Path()
    folder: Path | None = None
    anchors: Collection[str] = ()
    models: Mapping[str, str] = field(default_factory=dict)
    inside: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """A part of the report.

    Attributes:
        anchor: id of its heading.
        title: text of its heading.
        answer: what was found, in sentences.
        words: how it was found: what the charts show.
        charts: file name -> chart, for the page and the files beside it.
        tables: below the charts.
        note: remarks below the tables.
        files: file beside the page -> what it is called.
        html: what only a page has, after the tables.
        layout: whether the page lays out what is above; else all of it is in ``html``, in a form of its own.
    """

    anchor: str
    title: str
    answer: Sequence[str] = ()
    words: str = ""
    charts: Mapping[str, Chart] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    note: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    html: str = ""
    layout: bool = True


def to_html(section: Section) -> str:
    """What is below the heading on the page."""
    parts = _laid_out(section) if section.layout else []
    notes = dict.fromkeys(chart.note for chart in section.charts.values() if chart.note)
    return "".join([*parts, section.html, *(f'<p class="note">{escape(note)}</p>' for note in notes)])


def _laid_out(section: Section) -> list[str]:
    """Answer, charts, tables, note and links to files."""
    sentences = [f"<b>{escape(sentence)}</b>" for sentence in section.answer]
    answer = "".join(f"<li>{each}</li>" for each in sentences)
    parts = [f"<ul>{answer}</ul>" if len(sentences) > 1 else f"<p>{sentences[0]}</p>" if sentences else ""]
    parts += [f"<p>{escape(section.words)}</p>" if section.words else "", _charts(section.charts)]
    parts += [tables.to_html(each) for each in section.tables]
    parts += [f'<p class="note">{escape(section.note)}</p>' if section.note else ""]
    links = ", ".join(f'<a href="{file}">{escape(name)}</a>' for file, name in section.files.items())
    return [*parts, f'<p class="note">Files: {links}.</p>' if links else ""]


def to_markdown(section: Section, level: int = 2) -> str:
    """Heading, answer, charts by their files, tables; "" for a section that only a page can show."""
    if not (section.answer or section.charts or section.tables or section.files):
        return ""
    parts = [f"{'#' * level} {markdown_cell(section.title)}\n"]
    mark = "- " if len(section.answer) > 1 else ""
    parts += ["\n".join(f"{mark}**{markdown_cell(each)}**" for each in section.answer) + "\n"] * bool(
        section.answer
    )
    parts += [f"{markdown_cell(section.words)}\n"] * bool(section.words)
    parts += [f"![{markdown_cell(section.title)}](charts/{name}.svg)\n" for name in section.charts]
    parts += [f"{markdown_cell(each.caption)}\n\n{tables.to_markdown(each)}" for each in section.tables]
    parts += [f"{markdown_cell(section.note)}\n"] * bool(section.note)
    links = ", ".join(f"[{markdown_cell(name)}]({file})" for file, name in section.files.items())
    parts += [f"Files: {links}.\n"] * bool(links)
    return "\n".join(parts)


def to_latex(section: Section) -> str:
    """The tables."""
    return "\n".join(tables.to_latex([each]) for each in section.tables)


def _charts(charts: Mapping[str, Chart]) -> str:
    """The panels of one chart side by side; of several charts, those of one title, a dataset's."""
    entries = {name: look for chart in charts.values() for name, look in chart.legend.items()}
    if len(charts) < 2:
        panels = [panel for chart in charts.values() for panel in chart.panels]
        wide = [card(panel, panel.title) for panel in panels if panel.width > _WIDE]
        return legend(entries) + (
            "".join(wide[:_MOST_WIDE]) + rest(len(wide), _MOST_WIDE, "panels") or cards(panels)
        )
    groups: dict[str, list[str]] = {}
    for chart in charts.values():
        for panel in chart.panels:
            groups.setdefault(panel.title, []).append(card(panel, chart.title))
    parts = [
        f'<h3>{escape(title)}</h3><div class="charts">{"".join(group)}</div>'
        for title, group in list(groups.items())[:MOST_DATASETS]
    ]
    return legend(entries) + "".join([*parts, rest(len(groups), MOST_DATASETS, "datasets")])


def cards(panels: Iterable[Panel]) -> str:
    """Panels with their titles, side by side, as many as the page has room for."""
    every = list(panels)
    chosen = "".join(card(panel, panel.title) for panel in every[:MOST_PANELS])
    return f'<div class="charts">{chosen}</div>{rest(len(every), MOST_PANELS, "panels")}'


def rest(count: int, most: int, noun: str) -> str:
    """A note on what the page has no room for; "" if it has all."""
    if count <= most:
        return ""
    text = f"The first {most} of {count} {noun}; the files in <code>charts/</code> hold all."
    return f'<p class="note">{text}</p>'


def card(panel: Panel, caption: str) -> str:
    """A panel with a caption."""
    head = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="card">{head}{svg.page_panel(panel)}</figure>'


def legend(entries: Mapping[str, Look]) -> str:
    """Names of lines, marks and areas with a sample of each; "" for a single one."""
    if len(entries) < 2:
        return ""
    items = " &ensp; ".join(
        '<span style="white-space:nowrap"><svg class="swatch" width="26" height="12" aria-hidden="true">'
        f"{svg.swatch(look)}</svg> {escape(name)}</span>"
        for name, look in entries.items()
    )
    return f'<p class="note">{items}</p>'
