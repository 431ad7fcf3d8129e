"""The page's table of results: all rows and the means of each dataset, with sorting and filters."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from econgs_bench.reports import markup
from econgs_bench.reports.comparability import kind_of, rays_a_pixel, reason, replaced
from econgs_bench.reports.schema import COLUMNS, METRICS, by_name, frame, records
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, absent, mean_key, model, models
from econgs_bench.reports.tables.columns import axes, cell, numbers
from econgs_bench.reports.tables.ranks import UNDECIDED_NOTE, ranks
from econgs_bench.reports.tables.results import notes, omissions
from econgs_bench.reports.tables.table import UNDECIDED, UNDECIDED_SIGN, html_table

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.report import Report


_MOST_ROWS = 2000
"""Rows from which the page leaves out the single scenes of variants."""
_NUMBER = re.compile(r"-?[\d,]+(\.\d+)?")
"""A cell that the page's script sorts by its text."""
DETAILS = (
    "job", "commit", "machine", "processor", "fit_processor", "device", "threads", "variant", "rate",
    "preset", "split", "seed", "group", "iterations", "train_views", "width", "height", "samples", "one_ray",
    "group_seconds", "cpu_seconds", "encode_seconds", "group_bytes", "standalone_bytes",
    "group_peak_host_bytes", "fps_p05", "fps_p95", "reference_seconds", "identical_views", "stage", "reason",
    "scenes", "seeds", "note",
)  # fmt: skip
"""Columns of a row's details."""


def details(row: Any) -> list[str]:
    """The columns :data:`DETAILS` of a row of results or means; "" where one is missing."""
    return [
        "" if absent(row.get(name)) or row[name] == "" else by_name(name).text(row[name]) for name in DETAILS
    ]


FILES = {
    "results.csv": "CSV", "results.md": "Markdown", "results.tex": "LaTeX", "charts/": "charts",
    "report.md": "answers and tables of this page in Markdown", "report.tex": "in LaTeX",
}  # fmt: skip
"""File beside the page -> its name."""


def section(page: Page) -> Section | None:
    """The table with its controls, the meaning of its columns, and the unfinished runs."""
    return None if page.folder is None else Section("results", "Results", html=_html(page), files=FILES)


def _html(page: Page) -> str:
    report = page.report
    results, means = _chosen(report.measured), report.means
    names = numbers(results)
    writer = _Rows(report, names)
    columns = [by_name(name) for name in ("scene", "method", *names)]
    bodies = []
    for dataset, rows in results.groupby("dataset", sort=False):
        span, name = len(columns), escape(str(dataset))
        lines = [f'<tr class="group"><th scope="rowgroup" colspan="{span}">{name}</th></tr>']
        order = {scene: i for i, scene in enumerate(rows["scene"].unique())}
        # The methods of a scene are neighbours.
        rows = rows.sort_values("scene", key=lambda scenes: scenes.map(order), kind="stable")
        for kind in ("basic", "mean", "composed", "edited"):
            part = means[means["dataset"] == dataset] if kind == "mean" else rows[rows["kind"] == kind]
            write = writer.mean if kind == "mean" else writer.scene
            lines += [write(index, row) for index, row in _records(part)]
        bodies.append(f'<tbody data-dataset="{name}">{"".join(lines)}</tbody>')
    heads = "".join(
        f'<th scope="col"{" class=r" if column.name in names else ""} data-better="{column.better}">'
        f'<button type="button" title="{escape(column.doc)}">{escape(column.header)}</button></th>'
        for column in columns
    )
    details_of_rows = _interned(writer.details, list(writer.reasons))
    details_of_rows |= {"models": page.models, "inside": page.inside}
    return (
        f"{_controls(results)}"
        '<div class="wide tall" role="region" tabindex="0" aria-label="Results">'
        '<table class="results"><caption>One row per scene and method; below them the means of the dataset. '
        "A row opens to show the origin of its numbers.</caption>"
        f"<thead><tr>{heads}</tr></thead>{''.join(bodies)}</table></div>"
        f"{markup.data(details_of_rows, anchor='details')}"
        f"{_notes(report, names, writer)}{_floors(report)}{_failures(report)}"
    )


def _chosen(results: pd.DataFrame) -> pd.DataFrame:
    """All rows; of more than :data:`_MOST_ROWS` without the single scenes of variants, which have means."""
    if len(results) <= _MOST_ROWS:
        return results
    varied = (results["kind"] == "basic") & (results["variant"].fillna("") != "")
    rows: pd.DataFrame = results[~varied | (results["status"] != "ok")]
    return rows


def _interned(rows: list[list[str]], reasons: list[str]) -> dict[str, Any]:
    """Details of the rows, and reasons; what is repeated stands as its number among the words."""
    words = [word for word, count in Counter(word for row in rows for word in row).most_common() if count > 1]
    places: dict[str, int] = {word: i for i, word in enumerate(words)}
    titles = [by_name(name).header for name in DETAILS]
    short = [[places.get(word, word) for word in row] for row in rows]
    return {"names": titles, "words": words, "rows": short, "reasons": reasons}


def _records(table: pd.DataFrame) -> Iterable[tuple[Any, dict[str, Any]]]:
    """Index and row of each row."""
    return zip(table.index, records(table), strict=True)


class _Rows:
    """Writer of the rows; it collects their details in the same order."""

    def __init__(self, report: Report, numbers: list[str]) -> None:
        self.models = report.models
        self.places = {each: i for i, each in enumerate(models(report.measured))}
        self.numbers, self.axes = numbers, axes(report.measured)
        self.scene_marks, self.mean_marks = report.ranks, ranks(report.means, report.views)
        self.details: list[list[str]] = []
        self.reasons: dict[str, int] = {}
        self.left_out = False

    @property
    def marks(self) -> set[int]:
        """The marks of any cells."""
        return {*self.scene_marks.values(), *self.mean_marks.values()}

    def scene(self, index: Any, row: Any) -> str:
        cells = self._cells(row, self.scene_marks, index, _reasons(row))
        kind = "scene" if row["kind"] == "basic" else str(row["kind"])
        stale = not absent(row["stale"]) and row["stale"]
        tag = f" {markup.stale(row['changes'])}" if stale else ""
        tag = tag if row["status"] == "ok" else f" {markup.status(row)}"
        return self._line(row, kind, escape(str(row["scene"])), str(row["status"]), tag, cells)

    def mean(self, index: Any, row: Any) -> str:
        missing = dict.fromkeys(self.numbers, row["note"] or "missing in some scene")
        cells = self._cells(row, self.mean_marks, index, missing, spread=row["psnr_std"])
        seeds = f", {row['seeds']} seeds" if row["seeds"] > 1 else ""
        name = "all" if row["complete"] else self._hint("incomplete", row["note"])
        tag = f" {markup.stale(row['changes'])}" if row["changes"] else ""
        return self._line(row, "mean", f"{name} ({row['scenes']} scenes{seeds})", "mean", tag, cells)

    def _line(self, row: Any, kind: str, name: str, status: str, tag: str, cells: str) -> str:
        """A row; ``name``, ``tag`` and ``cells`` are HTML, ``status`` the filter's.

        The page's script takes the dataset from the body, the key of a scene from its details, and the method
        as its place in the filter: thousands of rows repeat little.
        """
        self.details.append(details(row))
        key = f' data-key="{escape(mean_key(row))}"' if kind == "mean" else ""
        state = "" if status in ("ok", "mean") else f' data-status="{escape(status)}"'
        method = self.places[model(row["method"], row["variant"])]
        settings = [
            f"seed {row[axis]}" if axis == "seed" else cell(axis, row[axis])
            for axis in self.axes
            if not absent(row.get(axis))
        ]
        about = f' <span class="soft">{escape(", ".join(settings))}</span>' if settings else ""
        return (
            f'<tr class="row {kind}" data-m={method}{state}{key}>'
            f'<th scope="row"><button>{name}</button>{about}</th>'
            f"<td>{markup.method(row, self.models)}{tag}</td>{cells}</tr>"
        )

    def _cells(
        self,
        row: Any,
        marks: dict[tuple[Any, str], int],
        index: Any,
        reasons: dict[str, str],
        spread: Any = None,
    ) -> str:
        cells = []
        for name in self.numbers:
            if absent(row[name]):
                why = reasons.get(name) or reasons.get("", "")
                cells.append(f"<td>{self._hint(MISSING, why) if why else MISSING}</td>")
                continue
            text = escape(cell(name, row[name]))
            if name == "psnr" and not absent(spread):
                text += f" ± {spread:.2f}"
            mark = marks.get((index, name), 0)
            if mark == UNDECIDED:
                text += f" {UNDECIDED_SIGN}"
            if kind := kind_of(row, name):
                text = f"({text}) {self._hint(kind, reason(row, name))}"
                self.left_out = True
            place = {1: " class=first", 2: " class=second"}.get(mark, "")
            plain = _NUMBER.fullmatch(text)
            value = "" if plain else f" data-v={float(row[name]):.5g}"
            cells.append(f"<td{place}{value}>{text}</td>")
        return "".join(cells)

    def _hint(self, text: str, why: str) -> str:
        """A text with an explanation, which the page's script adds: a few explain thousands of cells."""
        number = self.reasons.setdefault(str(why), len(self.reasons))
        return f"<abbr data-w={number}>{escape(text)}</abbr>"


def _controls(results: pd.DataFrame) -> str:
    """The filters; the page's script shows them."""
    statuses = [str(status) for status in results["status"].unique()]
    datasets = [str(name) for name in results["dataset"].unique()]
    methods = [each.title for each in models(results)]

    def select(name: str, text: str, options: list[tuple[str, str]]) -> str:
        items = "".join(
            f'<option value="{escape(v)}"{" selected" if i == 0 else ""}>{escape(label)}</option>'
            for i, (v, label) in enumerate(options)
        )
        return f'<label>{text} <select data-filter="{name}">{items}</select></label>'

    def values(name: str, text: str, options: list[str]) -> str:
        return select(name, text, [("", "all"), *((option, option) for option in options)])

    kinds = [("mean", "means of scenes"), ("scene", "single scenes"), ("", "both")]
    return (
        '<div class="controls" role="search" aria-label="Filter the results" hidden>'
        '<label>Filter <input type="search" data-filter="text" placeholder="words, all must occur"></label>'
        f"{values('dataset', 'Dataset', datasets)}{values('method', 'Method', methods)}"
        f"{values('status', 'Status', statuses)}{select('kind', 'Show', kinds)}"
        '<label><input type="checkbox" id="flat"> Sort across datasets</label>'
        '<button type="button" id="reset">Reset</button>'
        '<span id="count" role="status"></span></div>'
    )


def _notes(report: Report, names: list[str], writer: _Rows) -> str:
    results, marks = report.measured, writer.marks
    note = (
        "Rows “all”: quality and FPS are means over scenes, size and time are sums, memory is the maximum. "
        "Sizes are in MiB (2<sup>20</sup> bytes). "
    )
    if (results["kind"] == "composed").any():
        note += (
            "A composed row is several scenes rendered together; its size and time are sums over them. Means "
            "and sums exclude it. "
        )
    if (results["kind"] == "edited").any():
        note += (
            "An edited row is compared with the ground truth of the edited scene. Means and sums exclude it. "
        )
    if marks:
        note += "Among several methods the <b>best</b> is bold, the <u>second best</u> underlined. "
    if UNDECIDED in marks:
        note += f"{UNDECIDED_NOTE} "
    if len(results) > len(_chosen(results)):
        note += (
            f"Of more than {_MOST_ROWS:,} rows the page omits single scenes of variants; the files have all. "
        )
    note += f"{MISSING}: not measured. "
    if writer.left_out:
        note += (
            "A value in brackets takes no part in means, conclusions and charts; the reason is under the "
            "pointer. <code>bench run --retry busy</code> measures disturbed times again. "
        )
    for remark in (replaced(report.stored.get("superseded")), *notes(results)):
        note += f"<b>{escape(remark)}</b> " if remark else ""
    meanings = "".join(
        f"<dt>{escape(by_name(name).header)}</dt><dd>{escape(by_name(name).doc)}</dd>"
        for name in names
        if by_name(name).doc
    )
    return (
        f'<p class="note">{note}</p>'
        f'<details class="note"><summary>What the columns mean</summary><dl>{meanings}</dl></details>'
    )


def _floors(report: Report) -> str:
    """What the truth and one ray a pixel reach in each metric, folded; "" where that is not known."""
    table = report.stored["floors"] if "floors" in report.stored else frame("floors")
    names = [name for name in METRICS if table[name].notna().any()]
    lines = dict.fromkeys(
        (
            f"{row['dataset']} / {row['scene']}",
            _picture(row),
            *(cell(name, row[name]) for name in names),
        )
        for _, row in _records(table)
    )
    if not lines:
        return ""
    heads = ("Scene", "Picture", *(by_name(name).header for name in names))
    title = "What the truth itself reaches"
    return (
        f'<details class="note"><summary>{title}</summary>'
        "<p>The truth of each scene, and one ray a pixel, against the same views rendered with other, more "
        "rays: the floor. At 3 dB below it, half of a model's squared error is that of the truth.</p>"
        f"{html_table(title, heads, ([escape(text) for text in line] for line in lines))}</details>"
    )


def _picture(row: Mapping[str, Any]) -> str:
    known = row["picture"] == "truth" and not absent(row["samples"])
    return f"truth, {rays_a_pixel(int(row['samples']))}" if known else str(row["picture"])


def _failures(report: Report) -> str:
    unfinished = report.measured[report.measured["status"] != "ok"]
    if unfinished.empty:
        return ""
    lines = [
        [
            escape(f"{row['dataset']} / {row['scene']}"),
            markup.method(row, report.models),
            markup.status(row),
            escape(cell("stage", row["stage"])),
            f'<span class="wrap">{escape(cell("reason", row["reason"]))}</span>',
        ]
        for _, row in _records(unfinished)
    ]
    heads = ("Scene", "Method", "Status", "Stage", "Reason")
    return f'<h3 id="failures">Unfinished runs</h3>{html_table("Unfinished runs", heads, lines)}'


def _reasons(row: Any) -> dict[str, str]:
    """Column -> why it is missing; the key "" applies to all columns of an unfinished row."""
    if row["status"] != "ok":
        return {"": str(row["status"]) + ("" if absent(row["reason"]) else f": {row['reason']}")}
    return {name: reason for name, reason in omissions(row["omissions"]).items() if name in COLUMNS}
