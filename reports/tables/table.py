"""A table as a value, and its four renderings: HTML, text for a terminal, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.grid import Field, to_lines
from econgs_bench.reports.text import markdown_cell, one_line

FIRST, SECOND, UNDECIDED = 1, 2, 3
"""Marks of a cell: the best value, the second best, and one that is not ranked against its neighbours."""
UNDECIDED_SIGN = "\N{ALMOST EQUAL TO}"
_LONG = 30
"""Rows from which a table scrolls on its own on a screen, with fixed heads; print has all rows."""
_WRAPPED = 45  # characters from which a cell is broken on the page
_NO_LIMIT = 10**6

_HTML = {
    FIRST: '<b class="first">{}</b>',
    SECOND: '<u class="second">{}</u>',
    UNDECIDED: f"{{}} {UNDECIDED_SIGN}",
}
_TEXT = {0: "{} ", FIRST: "{}*", SECOND: "{}+", UNDECIDED: f"{{}}{UNDECIDED_SIGN}"}
_MARKDOWN = {FIRST: "**{}**", SECOND: "*{}*", UNDECIDED: f"{{}} {UNDECIDED_SIGN}"}
_LATEX = {FIRST: r"\textbf{{{}}}", SECOND: r"\underline{{{}}}", UNDECIDED: r"{}\rlap{{$^{{\approx}}$}}"}
"""LaTeX's sign of an undecided value takes no width: digits stay aligned."""


class Cell(NamedTuple):
    """A cell that is more than a text.

    Attributes:
        text: the value.
        mark: 0, or one of :data:`FIRST`, :data:`SECOND`, :data:`UNDECIDED`.
        below: a second line in small type.
    """

    text: str
    mark: int = 0
    below: str = ""


@dataclass(frozen=True)
class Table:
    """A table for people.

    Attributes:
        caption: what it is of.
        heads: titles of the columns.
        rows: cells; a text, or a :class:`Cell`. The first one names its row.
        numeric: whether each column is aligned to the right; empty: none is.
        notes: remarks below it.
        second: name of the second lines of cells, in a document that gives them a row of their own.
    """

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    numeric: Sequence[bool] = ()
    notes: Sequence[str] = ()
    second: str = ""

    def right(self, column: int) -> bool:
        """Whether a column is aligned to the right."""
        return bool(self.numeric) and self.numeric[column]

    @property
    def marked(self) -> bool:
        """Whether cells may have marks."""
        return any(isinstance(cell, Cell) for row in self.rows for cell in row)


def _plain(cell: str | Cell) -> Cell:
    return cell if isinstance(cell, Cell) else Cell(cell)


def _cells(
    row: Sequence[str | Cell], marks: Mapping[int, str], write: Callable[[str], str]
) -> Iterator[tuple[str, str]]:
    """Text with its mark, and second line, of each cell, in the signs of a format."""
    for cell in map(_plain, row):
        yield marks.get(cell.mark, "{}").format(write(cell.text)), write(cell.below)


def to_html(table: Table) -> str:
    """A table element, and its notes below it."""
    rows = [
        [
            _wrapped(text, _plain(cell).text) + (f'<br><span class="soft">{below}</span>' if below else "")
            for cell, (text, below) in zip(row, _cells(row, _HTML, escape), strict=True)
        ]
        for row in table.rows
    ]
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in table.notes)
    return html_table(table.caption, table.heads, rows, table.numeric) + notes


def _wrapped(html: str, text: str) -> str:
    if len(text) <= _WRAPPED:
        return html
    return f'<span class="wrap">{html}</span>'


def html_table(
    caption: str, heads: Iterable[str], rows: Iterable[Iterable[str]], numeric: Sequence[bool] = ()
) -> str:
    """A table that scrolls where it is too wide or long; the first cell names its row.

    Args:
        caption: title of the table, as text.
        heads: titles of the columns, as text.
        rows: cells of each row, as HTML.
        numeric: whether each column is aligned to the right.
    """
    heads = list(heads)
    align = [" class=r" if right else "" for right in numeric] or [""] * len(heads)
    head = "".join(f'<th scope="col"{at}>{escape(text)}</th>' for at, text in zip(align, heads, strict=True))
    lines = []
    for first, *others in rows:
        cells = "".join(f"<td{at}>{cell}</td>" for at, cell in zip(align[1:], others, strict=True))
        lines.append(f'<tr><th scope="row">{first}</th>{cells}</tr>')
    tall = " tall" if len(lines) > _LONG else ""
    return (
        f'<div class="wide{tall}" role="region" tabindex="0" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def to_text(table: Table, width: int = _NO_LIMIT) -> str:
    """Text for a terminal; ``*`` marks the best and ``+`` the second best value.

    Args:
        table: any.
        width: in characters; labels wrap where the table is wider.
    """
    marks = _TEXT if table.marked else {}
    columns: list[list[str]] = [[] for _ in table.heads]
    for row in table.rows:
        cells = list(_cells(row, marks, one_line))
        texts = [[text for text, _ in cells]]
        texts[0][0] = one_line(_plain(row[0]).text)
        if any(below for _, below in cells):
            tail = " " if marks else ""
            texts.append([f"  {table.second}", *(f"{below}{tail}" for _, below in cells[1:])])
        for line in texts:
            for column, text in zip(columns, line, strict=True):
                column.append(text)
    fields = [
        Field(head, cells, "number" if table.right(i) else "label")
        for i, (head, cells) in enumerate(zip(table.heads, columns, strict=True))
    ]
    return "\n".join([one_line(table.caption), *to_lines(fields, width), *_after("", table.notes)]) + "\n"


def _after(blank: str, notes: Sequence[str]) -> list[str]:
    return [blank, *notes] if notes else []


def to_markdown(table: Table) -> str:
    """A pipe table, the best value in bold, the second in italics; its notes are paragraphs below it."""
    lines = [
        "| " + " | ".join(map(markdown_cell, table.heads)) + " |",
        "|" + "|".join("---:" if table.right(i) else "---" for i in range(len(table.heads))) + "|",
    ]
    for row in table.rows:
        cells = (
            f"{text}<br>{below}" if below else text for text, below in _cells(row, _MARKDOWN, markdown_cell)
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, *(f"\n{markdown_cell(note)}" for note in table.notes)]) + "\n"


def to_latex(tables: Sequence[Table], notes: Sequence[str] = (), *, long: bool = False) -> str:
    """A booktabs tabular, the best value bold, the second underlined; notes below it.

    Args:
        tables: with the same heads: parts of one tabular, each after a rule and its caption, if it has one.
        notes: further ones, after those of the tables.
        long: a longtable instead, which breaks across pages.
    """
    first = tables[0]
    spec = "".join("r" if first.right(i) else "l" for i in range(len(first.heads)))
    head = [r"\toprule", " & ".join(map(tex, first.heads)) + r" \\"]
    if long:
        lines = [r"% needs \usepackage{booktabs,longtable}; wide: landscape, small type"]
        lines += [
            rf"\begin{{longtable}}{{{spec}}}",
            *head,
            r"\midrule",
            r"\endhead",
            r"\bottomrule",
            r"\endfoot",
        ]
    else:
        lines = [r"% needs \usepackage{booktabs}", rf"\begin{{tabular}}{{{spec}}}", *head]
    for table in tables:
        lines += [] if long else [r"\midrule"]
        if table.caption:
            lines.append(rf"\multicolumn{{{len(spec)}}}{{l}}{{\emph{{{tex(table.caption)}}}}} \\")
        for row in table.rows:
            cells = list(_cells(row, _LATEX, tex))
            lines.append(" & ".join(text for text, _ in cells) + r" \\")
            if any(below for _, below in cells):
                small = "".join(rf" & \footnotesize {below}" if below else " &" for _, below in cells[1:])
                lines.append(rf"\quad \footnotesize {table.second}" + small + r" \\")
    lines += [r"\end{longtable}"] if long else [r"\bottomrule", r"\end{tabular}"]
    every = dict.fromkeys([*(note for table in tables for note in table.notes), *notes])
    return "\n".join([*lines, *(rf"\par\noindent{{\footnotesize {tex(note)}\par}}" for note in every)]) + "\n"


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
