"""The sections of the page that hold charts and the small tables beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from html import escape
from itertools import chain
from typing import TYPE_CHECKING

from econgs_bench.reports.charts import data, features, kinds, stability_sections, training
from econgs_bench.reports.charts.chart import Chart, Panel
from econgs_bench.reports.charts.decision import decisions
from econgs_bench.reports.charts.economy import economy_section
from econgs_bench.reports.charts.elements import Section, card, cards, legend, rest, table
from econgs_bench.reports.charts.ladders import ladders_section
from econgs_bench.reports.charts.levels import by_panel
from econgs_bench.reports.charts.notes import noted, with_notes
from econgs_bench.reports.charts.races import races_section
from econgs_bench.reports.charts.unseen import unseen_section
from econgs_bench.reports.charts.volumes import volumes_section
from econgs_bench.reports.conclusions import rates
from econgs_bench.reports.curves import LEAST_POINTS, at_default_rates
from econgs_bench.reports.schema import records
from econgs_bench.reports.style import MISSING, MOST_NAMED, OTHERS_NAME, Look, absent, models, seconds
from econgs_bench.reports.tables import confidence
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.charts.report import Report

_HELD_OUT = "a few held-out views (of the measured split; no method trains on them)"
_GRAY = (
    f" A chart with more than {MOST_NAMED} variants colors and names each method's default alone; the others "
    "are gray and named when pointed at."
)
_DEFAULTS = f" Of more than {MOST_NAMED} variants each method's default is shown alone."
_ONE_RATE = " Of fits that differ only in a rate knob, the default's is shown."
_SEEDS = " Several rates of a method are compared on the seeds that all of them have."
_FRONT = (
    " They are without their single scenes. What is on the front keeps its color, and is named by its "
    "options."
)
_TRADEOFFS = (
    ("size", "PSNR and size", "size_bytes"),
    ("fps", "PSNR and speed", "fps"),
    ("time", "PSNR and training time", "train_seconds"),
    ("memory", "PSNR and host memory", "peak_host_bytes"),
    ("device-memory", "PSNR and device memory", "peak_device_bytes"),
)
"""Name of the file, caption, column."""
_ANYTIME = "training time per scene [s]"
_PSNR = "PSNR of a few held-out views [dB]"
_MOST_DATASETS = 8
"""Datasets of a section on the page."""
_ESTIMATE = "estimated size per scene [MiB]"
_CONVERGENCE = (
    ("seconds", "train_seconds", "training time of the fit [s]"),
    ("iterations", "iteration", "iteration"),
)
"""Name of the file, column, title of the axis."""


def charts(report: Report) -> Iterator[tuple[str, Chart]]:
    """The charts of the page with the names of their files."""
    if report.contests:
        yield from with_notes(decisions(report.contests[0], report.models), report).items()
    for section in chain(chart_sections(report.of_defaults), variant_sections(report)):
        yield from section.charts.items()


def chart_sections(report: Report) -> Iterator[Section]:
    """The sections for which there are data, in the order of the page, each when it is asked for."""
    makers: tuple[Callable[[Report], Section | None], ...] = (
        races_section,
        _confidence,
        _rate_distortion,
        _tradeoffs,
        volumes_section,
        ladders_section,
        stability_sections.stability_section,
        stability_sections.complexity_section,
        economy_section,
        unseen_section,
        _anytime,
        _convergence,
        _losses,
        _features,
        _timing,
        _ledger,
    )
    for make in makers:
        section = make(report)
        if section is not None:
            yield noted(section, report)


def _confidence(report: Report) -> Section | None:
    intervals, pairs = (table[table["metric"] == "psnr"] for table in (report.intervals, report.comparisons))
    if intervals.empty:
        return None
    several = [axis for axis in ("preset", "split") if intervals[axis].nunique() > 1]
    rows = []
    for _, group in intervals.groupby(["dataset", "preset", "split"], sort=False, dropna=False):
        of_dataset = records(group)
        best = str(max(of_dataset, key=lambda row: row["mean"])["method"])
        for row in of_dataset:
            cells = [row["dataset"], row["method"], *(row[axis] for axis in several), f"{row['mean']:.2f}"]
            cells += [confidence.ends(row["low"], row["high"]), _seeds(row)]
            rows.append([*cells, *_against(pairs, row, best)])
    heads = ["Dataset", "Method", *(axis.capitalize() for axis in several), "PSNR [dB]", "95 % interval"]
    heads += ["Over seeds", "To the highest [dB]", "95 % of the difference", "Ranking"]
    words = (
        "PSNR is a mean over views, scenes and seeds. Its 95 % interval holds the variation of views "
        "(circular block bootstrap; blocks of a sixth of the test path, since neighbouring views are alike) "
        "and of seeds; where there is one seed, that of views alone. Differences are taken view by view and "
        "seed by seed against the method with the highest mean; where their interval contains zero, the two "
        'are not ranked. All metrics: <a href="intervals.csv">intervals</a>, all pairs: '
        '<a href="comparisons.csv">comparisons</a>.'
    )
    html = f"<p>{words}</p>{table('PSNR, its uncertainty, and differences', heads, rows)}"
    return Section("confidence", "Uncertainty", html)


def _seeds(row: dict) -> str:
    if row["seeds"] < 2:
        return "one seed"
    values = ", ".join(f"{float(value):.2f}" for value in row["seed_values"].split("; ") if value)
    return f"± {row['seed_std']:.2f} ({row['seeds']} seeds)" + (f": {values}" if values else "")


def _against(pairs: pd.DataFrame, row: dict, best: str) -> list[str]:
    """Difference to the best, its interval, and what follows."""
    if row["method"] == best:
        return ["highest", "", ""]
    axes = ["dataset", "preset", "split"]
    same = (pairs[axes] == [row[axis] for axis in axes]).all(axis=1)
    for sign, mine, other in ((1, "first", "second"), (-1, "second", "first")):
        matches = pairs[same & (pairs[mine] == row["method"]) & (pairs[other] == best)]
        if len(matches):
            pair = matches.iloc[0]
            low, high = (end if absent(end) else sign * end for end in (pair["low"], pair["high"])[::sign])
            verdict = "lower" if pair["apart"] else "not ranked"
            difference = confidence.signed(sign * pair["difference"])
            return [difference, confidence.ends(low, high, sign=True), verdict]
    return [MISSING, MISSING, "other scenes"]


def _rate_distortion(report: Report) -> Section | None:
    panels = data.rate_panels(report.curves)
    if not panels:
        return None
    chart = kinds.rate_curves(panels, report.models)
    words = (
        "Mean PSNR over size per scene (logarithmic), at all rates that were measured; of methods of one "
        "size the default settings are a single mark. All as data: "
        '<a href="curves/">one JSON file per method and dataset</a>.'
    )
    words += _seeds_left_out(report)
    parts = [f"<p>{words}</p>{cards(chart.panels)}"]
    if report.differences:
        parts.insert(0, f"<p><b>{escape(rates.conclusion(report.differences, report.family))}</b></p>")
        rows = [rates.row(each) for each in report.differences]
        parts.append(table("Average differences", list(rates.HEADS), rows))
        parts.append(
            '<p class="note">BD-rate: bytes at equal PSNR against those of the other method. '
            f"BD-PSNR: dB at equal bytes. Interpolated with {rates.INTERPOLATION} splines over the "
            "logarithm of the size, averaged over the range that both curves cover: BD-rate over the PSNR "
            "they share, BD-PSNR over the sizes. Intervals are over test views and, with several seeds, over "
            "seeds, of one pair each; a lead is significant by Holm's correction over all leads of this "
            "page. Models that another of the same method beats in both are left out. Refused with fewer "
            f"than {LEAST_POINTS} others, and without overlap.</p>"
        )
    return Section("rate-distortion", "Rate and distortion", "".join(parts), {"rate-distortion": chart})


def _many(table: pd.DataFrame) -> bool:
    """Whether some panel of a dataset's variants has more than are named."""
    return any(len(models(rows)) > MOST_NAMED for _, rows in comparable(table))


def _rates_left_out(table: pd.DataFrame) -> str:
    """What to say of fits that charts of training and of attributes do not draw."""
    return _ONE_RATE if len(at_default_rates(table)) < len(table) else ""


def _seeds_left_out(report: Report) -> str:
    """What to say of seeds that some rates of a method were not measured with."""
    return _SEEDS if len(report.at_shared_seeds) < (report.results["kind"] == "basic").sum() else ""


def _tradeoffs(report: Report) -> Section | None:
    charts: dict[str, Chart] = {}
    captions: dict[str, list[str]] = {}
    for name, caption, column in _TRADEOFFS:
        panels = data.tradeoff(report.at_shared_seeds, column)
        # One setting of one method trades nothing.
        if panels := [panel for panel in panels if len(panel.lines) > 1 or len(panel.lines[0].means) > 1]:
            charts[f"psnr-{name}"] = chart = kinds.tradeoff(panels, column, report.models)
            for panel in chart.panels:
                captions.setdefault(panel.title, []).append(card(panel, caption))
    words = (
        "Large marks: mean over the dataset's scenes; small marks: single scenes. Horizontal axes are "
        "logarithmic. The dashed line is the Pareto front of the means; what lies in the shaded region is "
        f"worse than some method in both.{_seeds_left_out(report)}"
        f"{_GRAY + _FRONT if _many(report.results) else ''}"
    )
    return _by_dataset("tradeoffs", "Trade-offs", f"<p>{words}</p>", captions, charts)


def variant_sections(report: Report) -> Iterator[Section]:
    """PSNR over size of variants of options, beside their defaults; the other charts leave them out."""
    if report.of_variants is None:
        return
    panels = data.tradeoff(report.of_variants.at_shared_seeds, "size_bytes")
    chart = kinds.tradeoff(panels, "size_bytes", report.models)
    words = (
        "PSNR over size of methods with other options than their defaults, which all other charts leave out. "
        "The paper's tables and the table of results list them."
    )
    if panels:
        html = f"<p>{words}</p>{cards(chart.panels)}"
        yield noted(Section("variants", "Variants of options", html, {"variants": chart}), report)


def _by_dataset(
    anchor: str, title: str, head: str, cards: dict[str, list[str]], charts: dict[str, Chart]
) -> Section | None:
    """A section with the cards of each dataset below its name; None without any."""
    parts = [
        f'<h3>{escape(dataset)}</h3><div class="charts">{"".join(group)}</div>'
        for dataset, group in list(cards.items())[:_MOST_DATASETS]
    ]
    note = rest(len(cards), _MOST_DATASETS, "datasets")
    return Section(anchor, title, "\n".join([head, *parts, note]), charts) if charts else None


def _anytime(report: Report) -> Section | None:
    curve = report.tables["curve"]
    panels = {what: training.anytime(curve, report.results, what) for what in ("psnr", "bytes_estimate")}
    charts = {
        f"anytime-{name}": kinds.lines(
            panels[what],
            _ANYTIME,
            title,
            report.models,
            log_y=what != "psnr",
            floors=by_panel(report.results) if what == "psnr" else {},
        )
        for name, what, title in (("psnr", "psnr", _PSNR), ("size", "bytes_estimate", _ESTIMATE))
        if panels[what]
    }
    if not charts:
        return None
    words = (
        "What a method has reached after so many seconds of training, mean over scenes. A joint fit of n "
        f"scenes counts for each with its time / n. PSNR is of {_HELD_OUT}; size is "
        f"the method's own estimate."
    )
    entries = {
        name: look for each in panels.values() for name, look in kinds.legend_of(each, report.models).items()
    }
    heads = ["Dataset", "Method", *(f"{level:g} dB" for level in training.LEVELS)]
    rows = []
    for dataset, lines in panels["psnr"].items():
        for line in lines:
            times = [training.time_to_quality(line, level) for level in training.LEVELS]
            rows.append([dataset, line.title, *(MISSING if t is None else seconds(t) for t in times)])
    words += _rates_left_out(curve)
    words += _GRAY if OTHERS_NAME in entries else ""
    levels = table("Time to a quality", heads, rows) if rows else ""
    side_by_side = cards(panel for group in _by_title(charts).values() for panel in group)
    return Section(
        "anytime",
        "Quality over training time",
        f"<p>{words}</p>{legend(entries)}{side_by_side}{levels}"
        '<p class="note">Seconds of training per scene until the PSNR of these views first reaches the '
        f"level, linear between evaluations; {MISSING}: never.</p>",
        charts,
    )


def _convergence(report: Report) -> Section | None:
    curve = report.tables["curve"]
    charts: dict[str, Chart] = {}
    entries: dict[str, Look] = {}
    for name, against, title in _CONVERGENCE:
        if panels := training.convergence(curve, against):
            floors = by_panel(report.results)
            chart = kinds.lines(panels, title, _PSNR, report.models, log_x=False, floors=floors)
            charts[f"convergence-{name}"] = chart
            entries |= kinds.legend_of(panels, report.models)
    words = (
        f"PSNR of {_HELD_OUT} while training; the clock stands still while it is measured. Of more than "
        f"{training.MOST_FITS} fits a chart shows each method's mean."
    )
    words += _rates_left_out(curve)
    words += _GRAY if OTHERS_NAME in entries else ""
    captions = {dataset: [card(panel, "") for panel in group] for dataset, group in _by_title(charts).items()}
    return _by_dataset("convergence", "Convergence", f"<p>{words}</p>{legend(entries)}", captions, charts)


def _by_title(charts: dict[str, Chart]) -> dict[str, list[Panel]]:
    """Title -> the panels of all charts that have it."""
    groups: dict[str, list[Panel]] = {}
    for chart in charts.values():
        for panel in chart.panels:
            groups.setdefault(panel.title, []).append(panel)
    return groups


def _losses(report: Report) -> Section | None:
    steps = training.steps(report.tables)
    panels = training.losses(steps)
    if not panels:
        return None
    chart = kinds.losses(panels)
    words = (
        "The training loss and its weighted parts (logarithmic), means over stretches of the fits (50, which "
        "stages cut). A dashed line stands where a stage begins."
    )
    if "first" not in steps or steps["first"].isna().any():
        words += (
            " Of fits by older versions there are single steps; their dashed lines stand at the first one "
            "that has seen a part, which may have joined at any time since the one before."
        )
    small = sorted({name for panel in panels for name in panel.small})
    if small:
        words += f" Not drawn, for they are under {training.LEAST_SHARE:g} of it: {escape(', '.join(small))}."
    words += _rates_left_out(report.tables["curve"])
    words += _DEFAULTS if _many(steps) else ""
    return Section("losses", "Parts of the loss", f"<p>{words}</p>{cards(chart.panels)}", {"losses": chart})


def _features(report: Report) -> Section | None:
    attributes = report.tables["features"]
    panels = features.histograms(attributes)
    if not panels:
        return None
    charts = {"attributes": kinds.histograms(panels, report.models)}
    words = (
        "Distribution of what the primitives carry, all scenes of a dataset together. Quantised values are "
        "spread over neighbouring bins as far as their steps reach."
    )
    words += _rates_left_out(attributes)
    if _many(attributes):
        words += _DEFAULTS
    parts = [f"<p>{words}</p>{legend(charts['attributes'].legend)}{cards(charts['attributes'].panels)}"]
    try:
        charts["features-umap"] = chart = kinds.feature_maps(features.maps(attributes))
        parts.append(
            "<h3>Anchors by their features</h3><p>UMAP: neighbours have similar features; distances between "
            f"clusters, and their sizes, say little.</p>{legend(chart.legend)}{cards(chart.panels)}"
        )
    except features.Missing as why:
        parts.append(f'<p class="note">No map of anchors by their features: {escape(str(why))}.</p>')
    return Section("attributes", "Attributes", "".join(parts), charts)


def _timing(report: Report) -> Section | None:
    words = (
        "Where the time of a frame goes, mean over scenes and seeds. The parts are timed one by one, without "
        "what happens between them, which is “other”."
    )
    return _wholes("timing", "Time of a frame", words, kinds.timing(*data.timing(report.tables["timing"])))


def _ledger(report: Report) -> Section | None:
    words = (
        "Bytes of the files that a model is loaded from, by what they hold, over all scenes of a dataset, "
        "mean over seeds. Pointed at, a bar names its parts; what is under 1 % of every bar is “other”."
    )
    return _wholes("ledger", "Size ledger", words, kinds.ledger(*data.ledger(report.tables["ledger"])))


def _wholes(name: str, title: str, words: str, chart: Chart) -> Section | None:
    """The section of a chart of stacked bars; None without any."""
    if not chart.legend:
        return None
    parts = "".join(card(panel, "") for panel in chart.panels)
    return Section(name, title, f"<p>{words}</p>{legend(chart.legend)}{parts}", {name: chart})
