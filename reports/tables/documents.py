"""Tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.comparability import left_out
from econgs_bench.reports.schema import by_name
from econgs_bench.reports.style import MISSING, absent, row_label
from econgs_bench.reports.tables.columns import cell, is_results
from econgs_bench.reports.tables.ranks import UNDECIDED, UNDECIDED_NOTE, UNDECIDED_SIGN, ranks
from econgs_bench.reports.tables.results import marked, with_notes
from econgs_bench.reports.text import csv_cell, markdown_cell, one_line

if TYPE_CHECKING:
    import pandas as pd

Marks = Mapping[tuple[Any, str], int]
"""(row index, column) -> place."""
MARKDOWN_MARKS = {1: "**{}**", 2: "*{}*", UNDECIDED: f"{{}} {UNDECIDED_SIGN}"}
TEX_MARKS = {1: r"\textbf{{{}}}", 2: r"\underline{{{}}}", UNDECIDED: r"{}\rlap{{$^{{\approx}}$}}"}
"""Formats of marked values. LaTeX's sign of an undecided value takes no width: digits stay aligned."""


def to_csv(table: pd.DataFrame) -> str:
    """All columns with raw values, texts as :func:`.reports.text.csv_cell`; a missing value is empty.

    Numbers have Python's digits. NumPy's would be fewer after any library in the process has set its print
    options (colour-science does).
    """
    import pandas as pd

    plain = table.copy()
    for name in plain.columns:
        if plain[name].dtype.kind == "f":
            values = plain[name].to_numpy(float, na_value=np.nan).tolist()
            plain[name] = pd.Series([None if v != v else v for v in values], plain.index, dtype=object)
        elif plain[name].dtype.kind not in "iub":
            plain[name] = plain[name].map(lambda value: csv_cell(value) if isinstance(value, str) else value)
    return plain.to_csv(index=False, lineterminator="\n")


def to_markdown(table: pd.DataFrame, marks: Marks | None = None, remark: str = "") -> str:
    """A pipe table; the best value in bold, the second in italics. `results` is cut to :func:`display`.

    Args:
        table: `results` or any other.
        marks: as of :func:`ranks`; None for those that means alone decide.
        remark: a note below the table, after those that follow from its rows.
    """
    marks = ranks(table) if marks is None else marks
    out = left_out(table)
    table, notes = with_notes(table)
    columns = [by_name(name) for name in table.columns]
    lines = [
        "| " + " | ".join(markdown_cell(column.header) for column in columns) + " |",
        "|" + "|".join("---:" if column.numeric else "---" for column in columns) + "|",
    ]
    for row in _rows(table, marks, out):
        texts = (MARKDOWN_MARKS.get(mark, "{}").format(markdown_cell(text)) for text, mark in row)
        lines.append("| " + " | ".join(texts) + " |")
    notes += [remark] if remark else []
    notes += [UNDECIDED_NOTE] if UNDECIDED in marks.values() else []
    return "\n".join([*lines, *(f"\n{markdown_cell(note)}" for note in notes)]) + "\n"


def to_latex(table: pd.DataFrame, marks: Marks | None = None, remark: str = "") -> str:
    """A booktabs table; the best value bold, the second underlined. `results` is cut to :func:`display`.

    `results` is a longtable, which breaks across pages; any other table is a tabular. Arguments as of
    :func:`to_markdown`.
    """
    marks = ranks(table) if marks is None else marks
    results = is_results(table)
    notes = [UNDECIDED_NOTE] if UNDECIDED in marks.values() else []
    notes += _unfinished(table) if results else []
    out = left_out(table)
    table, more = with_notes(table)
    notes += [*more, *([remark] if remark else [])]
    if results:
        table = table.drop(columns="reason", errors="ignore")
    columns = [by_name(name) for name in table.columns]
    spec = "".join("r" if column.numeric else "l" for column in columns)
    head = [r"\toprule", " & ".join(tex(column.header) for column in columns) + r" \\", r"\midrule"]
    if results:
        lines = [r"% needs \usepackage{booktabs,longtable}; wide: landscape, small type"]
        lines += [rf"\begin{{longtable}}{{{spec}}}", *head, r"\endhead", r"\bottomrule", r"\endfoot"]
    else:
        lines = [r"% needs \usepackage{booktabs}", rf"\begin{{tabular}}{{{spec}}}", *head]
    for row in _rows(table, marks, out):
        lines.append(" & ".join(TEX_MARKS.get(mark, "{}").format(tex(text)) for text, mark in row) + r" \\")
    lines += [r"\end{longtable}"] if results else [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*lines, *tex_notes(notes)]) + "\n"


def _rows(
    table: pd.DataFrame, marks: Marks, out: Collection[tuple[Any, str]]
) -> Iterator[list[tuple[str, int]]]:
    """Text and mark of each cell, row by row; what is left out of comparisons is in brackets."""
    columns = [[cell(name, value) for value in table[name].tolist()] for name in table.columns]
    for index, *texts in zip(table.index, *columns, strict=True):
        yield [
            (marked(text, (index, name) in out), marks.get((index, name), 0))
            for name, text in zip(table.columns, texts, strict=True)
        ]


def _unfinished(results: pd.DataFrame) -> list[str]:
    """Each unfinished row with its reason."""
    return [
        f"{row['dataset']}, {row['scene']}, {row_label(row)}: "
        f"{row['status']}{'' if absent(row['reason']) else f' ({row.reason})'}"
        for _, row in results[results["status"] != "ok"].iterrows()
    ]


def tex_notes(notes: Iterable[str]) -> list[str]:
    """Notes below a LaTeX table, one paragraph each."""
    return [rf"\par\noindent{{\footnotesize {tex(note)}\par}}" for note in notes]


_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\n": " ", "Δ": r"$\Delta$",
    "±": r"$\pm$", MISSING: "--",
    "\N{MINUS SIGN}": "$-$",
    "*": r"$^{*}$", UNDECIDED_SIGN: r"$\approx$", "\N{MULTIPLICATION SIGN}": r"$\times$",
}  # fmt: skip


def tex(text: str) -> str:
    """Text with the characters escaped that are commands in LaTeX."""
    return "".join(_TEX.get(sign, sign) for sign in one_line(text.replace("\n", " ")))
