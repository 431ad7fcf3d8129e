"""The page's first screen: which method is best at what, the chart that decides, and methods by criteria."""

from __future__ import annotations

import re
from collections.abc import Container
from html import escape
from typing import TYPE_CHECKING

from econgs_bench.reports import markup
from econgs_bench.reports.charts import svg
from econgs_bench.reports.floors import mean
from econgs_bench.reports.schema import COLUMNS
from econgs_bench.reports.sections.answers import contest
from econgs_bench.reports.sections.answers.chart import decisions
from econgs_bench.reports.sections.answers.conclusion import BEST_PICTURE, answers_of, scope
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import Model, counted, label, look, model_named
from econgs_bench.reports.tables.table import Table

if TYPE_CHECKING:
    from econgs_bench.reports.charts.chart import Chart
    from econgs_bench.reports.sections.answers.conclusion import Answer
    from econgs_bench.reports.sections.answers.contest import Contest

_EVIDENCE = {
    "Smallest": ["ledger"], BEST_PICTURE: ["confidence"], "Fastest to train": ["anytime"],
    "Fastest to draw": ["timing"], "Least memory": ["tradeoffs"], "Most robust": ["ladders", "stability"],
    "Can be edited": ["editing"],
}  # fmt: skip
"""Criterion -> anchors of sections with its evidence, the first of which that the page has is linked."""
_SHADES = 4


def section(page: Page) -> Section | None:
    """The answers of the first contest; None where no two methods can be compared."""
    every = contest.of_report(page.report)
    if not every:
        return None
    found = answers_of(page.report, page.family)
    models = page.report.models
    charts = decisions(every[0], models)
    entries = "".join(_entry(answer, models) for answer in found)
    html = (
        f'<div class="answer"><dl>{entries}</dl>{_charts(charts)}</div>'
        f"<p>{escape(scope(every[0]))}</p>{_matrix(found, every[0], models, page.anchors)}"
    )
    table = Table("", ("", ""), [[answer.title, answer.sentence] for answer in found])
    answer = [scope(every[0])]
    return Section("answers", "Which method?", answer, "", charts, [table], html=html, layout=False)


def _entry(answer: Answer, models: list[Model]) -> str:
    head = escape(answer.title)
    sentence = re.sub(r" among \d+ leads? of this page", "", answer.sentence)  # the words below have it
    text = re.sub("`(.*?)`", r"<code>\1</code>", escape(sentence))
    if answer.winner:
        name = escape(label(answer.winner))
        text = f"<b>{_dot(answer.winner, models)}{name}</b>{text.removeprefix(name)}"
    return f"<div><dt>{head}</dt><dd>{text}</dd></div>"


def _dot(method: str, models: list[Model]) -> str:
    return markup.dot(look(model_named(method), models))


def _charts(charts: dict[str, Chart]) -> str:
    """The charts, one at a time; a row of buttons selects it."""
    if not charts:
        return ""
    inputs, figures = [], []
    for i, (name, chart) in enumerate(charts.items()):
        (panel,) = chart.panels
        checked = " checked" if i == 0 else ""
        button = f'<input type="radio" name="decision" value="{name}"{checked}>'
        inputs.append(f"<label>{button} {escape(panel.title)}</label>")
        figures.append(f'<figure class="card" data-decision="{name}">{svg.page_panel(panel)}</figure>')
    return (
        f'<div class="decision"><div class="controls">PSNR against {"".join(inputs)}</div>{"".join(figures)}'
        '<p class="note">Bars are 95 % intervals; a dashed line joins the methods that no other is better '
        "than in both, where there are several.</p></div>"
    )


def _matrix(answers: list[Answer], contest: Contest, models: list[Model], anchors: Container[str]) -> str:
    """Methods by criteria: figures, shaded from the best to the worst."""
    heads = ['<th scope="col">Method</th>']
    for answer in answers:
        title = escape(answer.title)
        anchor = next((name for name in _EVIDENCE[answer.title] if name in anchors), "")
        link = f'<a href="#{anchor}">{title}</a>' if anchor else title
        heads.append(f'<th scope="col">{link}</th>')
    lines = []
    for method in contest.methods:
        cells = "".join(_cell(answer, method) for answer in answers)
        lines.append(f'<tr><th scope="row">{_dot(method, models)}{escape(label(method))}</th>{cells}</tr>')
    lines += _floor(answers, contest)
    return (
        '<div class="wide" role="region" tabindex="0" aria-label="Methods by criteria"><table class="matrix">'
        "<caption>Methods by criteria: means per scene, shaded from best to worst, and on how many scenes a "
        "method is first; a criterion leads to its "
        f"evidence.</caption><thead><tr>{''.join(heads)}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _floor(answers: list[Answer], contest: Contest) -> list[str]:
    """A row with the noise floor under the criterion of PSNR; none where no scene has one."""
    cells = next(iter(contest.values("psnr").cells.values()), {})
    every = [[contest.floors[dataset][scene] for scene in scenes] for dataset, scenes in cells.items()]
    known = [floor.truth for own in every for floor in own if floor is not None]
    if not known:
        return []
    text = f"<small>{min(known):.1f} to {max(known):.1f} dB on {len(known)} of "
    text += f"{counted(sum(map(len, every)), 'scene')}</small>"
    whole = mean(mean(own) for own in every)
    text = text if whole is None else f"{COLUMNS['floor'].text(whole.truth)} dB<br>{text}"
    row = "".join(f"<td>{text if answer.title == BEST_PICTURE else ''}</td>" for answer in answers)
    return [f'<tr class="soft"><th scope="row">Floor of the truth</th>{row}</tr>']


def _cell(answer: Answer, method: str) -> str:
    found = answer.place(method)
    if found is None:
        return '<td class="soft">\N{EN DASH}</td>'
    own, rank = found
    shade = round(_SHADES * (1.0 - rank / max(1, len(answer.places) - 1)))
    text = escape(own.text)
    if firsts := answer.firsts(own):
        text += f"<br><small>{firsts}</small>"
    first = " first" if method == answer.winner else ""
    return f'<td class="shade{shade}{first}">{text}</td>'
