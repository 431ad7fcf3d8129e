"""The report: one HTML file that needs no network. The same charts and tables are files beside it."""

from __future__ import annotations

import base64
import gzip
import hashlib
import re
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports.charts import files as chart_files
from econgs_bench.reports.charts import svg
from econgs_bench.reports.comparability import sentences
from econgs_bench.reports.files import write_files, write_text
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.order import family, first, sections
from econgs_bench.reports.sections.paper.tables import paper_tables
from econgs_bench.reports.sections.pictures import section as pictures
from econgs_bench.reports.sections.section import Page, Section, to_html, to_latex, to_markdown
from econgs_bench.reports.style import absent, counted, label
from econgs_bench.reports.text import markdown_cell, xml_text

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    import pandas as pd

    from econgs_bench.reports.sections.paper.values import PaperTable

_WEB = Path(__file__).parent / "web"
MODEL_BYTES = 3_000_000
"""Pages of models inside a report, together."""
_SCRIPT = re.compile(rb"script-src ('sha256-[\w+/=]+')")
_FEW_REMARKS = 4
_LONG = 50  # characters from which a fact has a wide box


def write_report(
    tables: dict[str, pd.DataFrame],
    root: Path,
    out: Path,
    paper: Sequence[PaperTable] | None = None,
    report: Report | None = None,
    models: Mapping[str, Path] | None = None,
) -> Path:
    """Write the report, its answers and tables as ``.md`` and ``.tex``, and the files of
    :func:`.reports.files.write_files`; panels go into ``charts/``.

    Args:
        tables: the tables of :mod:`.reports.schema`.
        root: folder that the paths of pictures in ``views`` are relative to.
        out: the HTML file.
        paper: the paper's tables of the same rows, if the caller has them.
        report: the same tables, if the caller has them so.
        models: job of a row -> page of its model; small ones are put into the report.

    Returns:
        ``out``.
    """
    report = report or Report(tables)
    paper = paper_tables(tables, report.views) if paper is None else paper
    folder = out.parent / "charts"
    linked = {job: file.relative_to(out.parent).as_posix() for job, file in (models or {}).items()}
    inside = _inside(out.parent, set(linked.values()))
    packed = {name: _packed(text) for name, text in inside.items()}
    page = Page(report, family(report), paper, root, folder, models=linked, inside=packed)
    parts: list[Section] = []
    with chart_files.output(folder) as write_charts:
        for section in sections(page):
            write_charts(section.charts)
            parts.append(section)
        start = first(replace(page, anchors=[part.anchor for part in parts]))
        if start is not None:
            write_charts(start.charts)
            parts.insert(0, start)
        write_files(report, out.parent, paper)
        name = _name(report.stored["dvr"] if report.results.empty else report.results)
        texts = [f"# {markdown_cell(name)}\n", *filter(None, map(to_markdown, parts))]
        write_text(out.with_name("report.md"), "\n".join(texts))
        write_text(out.with_name("report.tex"), "\n".join(filter(None, map(to_latex, parts))))
        head = _head(name, report.measured, parts, sentences(report.remarks))
        write_text(out, xml_text(document(name, head, parts, held=inside.values())))
    return out


def _packed(text: bytes) -> str:
    return base64.b64encode(gzip.compress(text, 9, mtime=0)).decode()


def _inside(folder: Path, names: Collection[str]) -> dict[str, bytes]:
    """The smallest pages of models, as many as the report holds."""
    size, inside = 0, {}
    for name in sorted(names, key=lambda name: ((folder / name).stat().st_size, name)):
        size += (folder / name).stat().st_size
        if size > MODEL_BYTES:
            break
        inside[name] = (folder / name).read_bytes()
    return inside


def document(
    name: str, head: str, parts: Sequence[Section], *, folded: bool = True, held: Iterable[bytes] = ()
) -> str:
    """A page of sections.

    Args:
        name: its title.
        head: HTML above the sections.
        parts: the sections.
        folded: whether those after the answers are closed at first.
        held: pages that it opens, which browsers let run no script but what it may run itself.
    """
    body = "\n".join(
        f'<section aria-labelledby="{part.anchor}"><h2 id="{part.anchor}">{escape(part.title)}</h2>\n'
        f"{to_html(part)}</section>"
        if not folded or _is_open(part, parts)
        else f'<details class="part"><summary><h2 id="{part.anchor}">{escape(part.title)}</h2></summary>\n'
        f"{to_html(part)}</details>"
        for part in parts
    )
    scripts = ["theme.js", "fold.js", "table.js"]
    if 'class="compare"' in body:
        body += pictures.COMPARE
        scripts.append("compare.js")
    if 'class="chart"' in body:
        scripts.append("charts.js")
    code = '"use strict";\n' + "\n".join((_WEB / file).read_text(encoding="utf-8") for file in scripts)
    css = (_WEB / "page.css").read_text(encoding="utf-8") + svg.theme()
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(code, held)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(name)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n"
        f'<a class="skip" href="#main">Skip to the content</a>\n<div class="page">\n<header>{head}</header>\n'
        f'<main id="main">\n{body}\n</main>\n</div>\n'
        f"<script>{code}</script>\n</body>\n</html>\n"
    )


def _is_open(part: Section, parts: Sequence[Section]) -> bool:
    """Whether a section is unfolded: the answers, and pictures; all of them in a report without answers."""
    return (
        part.anchor == "answers"
        or (part.anchor == "scenes" and pictures.INLINE in part.html)
        or parts[0].anchor != "answers"
    )


def _policy(script: str, held: Iterable[bytes] = ()) -> str:
    """Content security policy: the browser runs this script and those of pages inside; it fetches nothing."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    others = {match[1].decode() for text in held if (match := _SCRIPT.search(text))}
    scripts = " ".join([f"'sha256-{digest}'", *sorted(others)])
    more = (" blob:", "worker-src blob:; ") if others else ("", "")
    return (
        f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src data:{more[0]}; "
        f"{more[1]}base-uri 'none'; form-action 'none'"
    )


def _name(results: pd.DataFrame) -> str:
    names = [str(name) for name in results["dataset"].dropna().unique()]
    if len(names) > 4:
        return f"Benchmark report: {len(names)} datasets"
    return f"Benchmark report: {', '.join(names)}" if names else "Benchmark report"


def _scene_count(results: pd.DataFrame) -> str:
    kinds = results[["dataset", "scene", "kind"]].drop_duplicates()["kind"].value_counts()
    others = [f"{kinds[kind]} {kind}" for kind in ("composed", "edited") if kind in kinds]
    return ", ".join([str(kinds.get("basic", 0)), *others])


def _values(results: pd.DataFrame, column: str) -> str:
    """The distinct values of a column, in order."""
    return ", ".join(str(value) for value in results[column].dropna().unique() if str(value))


def _pair(results: pd.DataFrame, *columns: str) -> str:
    return ", ".join(values for column in columns if (values := _values(results, column)))


def _methods(results: pd.DataFrame) -> str:
    """The methods; of a method with several variants only their number."""
    variants = results.fillna({"variant": ""}).groupby("method", sort=False)["variant"].unique()
    return ", ".join(
        label(method, names[0]) if len(names) == 1 else f"{label(method)} in {len(names)} variants"
        for method, names in variants.items()
    )


def _head(name: str, results: pd.DataFrame, parts: list[Section], remarks: Sequence[str]) -> str:
    """Heading, counts of statuses, what is not compared, links to the sections, and facts about the runs."""
    title = f'<h1>{escape(name)}</h1><button type="button" id="theme" hidden></button>'
    links = "".join(f'<li><a href="#{part.anchor}">{escape(part.title)}</a></li>' for part in parts)
    nav = f'<nav aria-label="Sections"><ul>{links}</ul></nav>' if links else ""
    if results.empty:
        if parts:
            return title + nav
        return f"{title}<p>The run store holds no results yet. <code>bench run quick</code> makes some.</p>"
    sizes = {
        f"{w} \N{MULTIPLICATION SIGN} {h}"
        for w, h in zip(results["width"], results["height"], strict=True)
        if not absent(w)
    }
    facts = [
        ("Methods", _methods(results)),
        ("Datasets", _values(results, "dataset")),
        ("Scenes", _scene_count(results)),
        ("Preset, split", _pair(results, "preset", "split")),
        ("Image size", ", ".join(sorted(sizes))),
        ("Training views", _values(results, "train_views")),
        ("Seeds", _values(results, "seed")),
        ("Machine, device", _pair(results, "machine", "device")),
    ]
    cards = "".join(
        f'<div class="fact{" long" if len(v) > _LONG else ""}"><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>'
        for k, v in facts
        if v
    )
    tags = " ".join(
        f'<span class="tag {"ok" if status == "ok" else "bad"}">{count} {escape(str(status))}</span>'
        for status, count in results["status"].value_counts().items()
    )
    if (results["status"] != "ok").any():
        tags += ' <a href="#failures">unfinished runs</a>'
    stale = int(results["stale"].fillna(False).astype(bool).sum())
    if stale:
        tags += f' <span class="tag stale">{stale} stale: method or settings are others today</span>'
    facts_of_runs = f'<details><summary>About these runs</summary><dl class="facts">{cards}</dl></details>'
    return f"{title}<p>{tags}</p>{_remarks(remarks)}{facts_of_runs}{nav}"


def _remarks(texts: Sequence[str]) -> str:
    """What is not compared; many remarks are folded."""
    if not texts:
        return ""
    lines = "".join(f"<li>{escape(text)}</li>" for text in texts)
    unfolded = " open" if len(texts) <= _FEW_REMARKS else ""
    title = f"Not compared: {counted(len(texts), 'remark')}"
    return f'<details id="differences"{unfolded}><summary>{title}</summary><ul>{lines}</ul></details>'
