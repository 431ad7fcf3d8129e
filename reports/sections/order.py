"""The sections of a report in their order, which page, files, terminal and documents walk over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.family import Family
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.sections.answers import contest
from econgs_bench.reports.sections.answers import section as answers_section
from econgs_bench.reports.sections.answers.conclusion import CRITERIA, Answer, answers_of, compare
from econgs_bench.reports.sections.anytime import section as anytime
from econgs_bench.reports.sections.attributes import section as attributes
from econgs_bench.reports.sections.datasets import section as datasets
from econgs_bench.reports.sections.economy import section as economy
from econgs_bench.reports.sections.editing import section as editing
from econgs_bench.reports.sections.ladders import section as ladders
from econgs_bench.reports.sections.losses import section as losses
from econgs_bench.reports.sections.notes import noted
from econgs_bench.reports.sections.paper import verdicts
from econgs_bench.reports.sections.parts import section as parts
from econgs_bench.reports.sections.pictures import section as pictures
from econgs_bench.reports.sections.provenance import section as provenance
from econgs_bench.reports.sections.races import conclusion as race_conclusion
from econgs_bench.reports.sections.races import section as races
from econgs_bench.reports.sections.rates import conclusion as rate_conclusion
from econgs_bench.reports.sections.rates import section as rates
from econgs_bench.reports.sections.results import section as results
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.stability import section as stability
from econgs_bench.reports.sections.tradeoffs import section as tradeoffs
from econgs_bench.reports.sections.uncertainty import section as uncertainty
from econgs_bench.reports.sections.unseen import section as unseen
from econgs_bench.reports.sections.views import section as views
from econgs_bench.reports.sections.volumes import section as volumes

Maker = Callable[[Page], Section | None]

ROWS: tuple[Maker, ...] = (
    pictures.section, results.section, verdicts.section, editing.section, views.section,
)  # fmt: skip
"""Sections of all rows."""
QUESTIONS: tuple[Maker, ...] = (
    races.section, uncertainty.section, rates.section, tradeoffs.section, volumes.section, ladders.section,
    ladders.breaks, stability.section, stability.complexity, economy.section, unseen.section,
    anytime.section, losses.section, attributes.section, parts.frame_time, parts.size, tradeoffs.variants,
)  # fmt: skip
"""Sections of the rows without variants of options."""
ORIGINS: tuple[Maker, ...] = (datasets.section, provenance.section)
"""Sections at the end."""


@once
def family(report: Report) -> Family:
    """All leads of a page, whichever part of it asks."""
    whole = report.whole
    compared = [compare(each, one) for one in contest.of_report(whole)[:1] for each in CRITERIA]
    of_answers = [one.p for one in compared if one is not None]
    of_races = [lead.p for race in race_conclusion.of_report(whole) for lead in race.leads]
    of_rates = rate_conclusion.p_values(rate_conclusion.of_report(whole.of_defaults))
    return Family.of([*of_answers, *of_races, *of_rates])


@once
def answers(report: Report) -> list[Answer]:
    """The answers of the first contest; empty without one."""
    return answers_of(report, family(report))


def sections(page: Page) -> Iterator[Section]:
    """The sections for which there are data, each when it is asked for; the answers are :func:`first`."""
    defaults = replace(page, report=page.report.of_defaults)
    if not page.report.results.empty:
        yield from _made(ROWS, page)
        yield from _made(QUESTIONS, defaults)
    yield from _made(ORIGINS, page)


def first(page: Page) -> Section | None:
    """The first screen; its links lead to the anchors that the page has."""
    return next(_made((answers_section.section,), page), None)


def chart_sections(report: Report) -> Iterator[Section]:
    """The sections of these rows alone that have charts, without pictures."""
    for made in _made(QUESTIONS, Page(report, family(report))):
        if made.charts:
            yield made


def charts(report: Report) -> Iterator[tuple[str, Chart]]:
    """The charts of the page with the names of their files."""
    made = first(Page(report, family(report)))
    for each in [*([made] if made is not None else []), *chart_sections(report.of_defaults)]:
        yield from each.charts.items()


def _made(makers: tuple[Maker, ...], page: Page) -> Iterator[Section]:
    for make in makers:
        made = make(page)
        if made is not None:
            yield noted(made, page.report)
