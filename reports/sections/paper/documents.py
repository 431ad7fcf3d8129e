"""The paper's tables as documents: Markdown, HTML, LaTeX, and text for a terminal."""

from __future__ import annotations

from html import escape

from econgs_bench.reports.sections.paper.values import (
    NOT_MEASURED,
    QUANTITIES,
    Block,
    PaperTable,
    Quantity,
    Value,
)
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables import table as tables
from econgs_bench.reports.tables.table import Cell, Table
from econgs_bench.reports.text import markdown_cell


def measured_text(value: Value, quantity: Quantity) -> str:
    """The measured value, as "36.74" or "36.74 ± 0.05"; an en dash if it is missing."""
    if value.mean is None:
        return MISSING
    text = f"{value.mean:,.{quantity.digits}f}"
    return text if value.spread is None else f"{text} ± {value.spread:,.{quantity.digits}f}"


def published_text(value: Value, quantity: Quantity, same: bool) -> str:
    """The published value and, for the same dataset, measured - published: "36.50 (+0.24)"."""
    if value.published is None:
        return ""
    text = f"{value.published:,.{quantity.digits}f}"
    if value.mean is None or not same:
        return text
    return f"{text} ({value.mean - value.published:+,.{quantity.digits}f})"


def _heading(block: Block) -> str:
    if not block.published:
        second = "no published values"
    elif block.same:
        second = f"second line: published for {block.published} (difference)"
    else:
        second = f"second line: published for {block.published}, which is other data"
    return f"{block.dataset}: {block.scenes}; {second}"


def to_markdown(paper: PaperTable) -> str:
    """A pipe table per block; best in bold, second best in italics."""
    parts = [f"### {markdown_cell(paper.title)}\n"]
    parts += [f"{markdown_cell(each.caption)}\n\n{tables.to_markdown(each)}" for each in _tables(paper)]
    return "\n".join(parts)


def to_html(paper: PaperTable) -> str:
    """A table element per block, with small published values below the measured ones."""
    return "\n".join([f"<h3>{escape(paper.title)}</h3>", *map(tables.to_html, _tables(paper))])


def to_latex(paper: PaperTable) -> str:
    """One booktabs tabular with a rule between blocks; best bold, second best underlined; notes below it."""
    remarks: dict[str, list[str]] = {}
    for block in paper.blocks:
        for text in _remarks(block):
            remarks.setdefault(text, []).append(f"{block.dataset} ({block.protocol})")
    # A remark on all blocks appears once, without their names.
    notes = [
        f"{', '.join(blocks)}: {text}" if len(blocks) < len(paper.blocks) else text
        for text, blocks in remarks.items()
    ]
    return tables.to_latex([_table(paper, block, notes=False) for block in paper.blocks], notes)


def to_text(paper: PaperTable) -> str:
    """Text for a terminal: two lines a row; ``*`` marks the best and ``+`` the second best value."""
    parts = [paper.title, *(tables.to_text(each).rstrip("\n") for each in _tables(paper))]
    return "\n\n".join(parts) + "\n"


def _tables(paper: PaperTable) -> list[Table]:
    return [_table(paper, block) for block in paper.blocks]


def _table(paper: PaperTable, block: Block, *, notes: bool = True) -> Table:
    """A block: measured values with their marks, and published ones below them."""
    rows: list[list[str | Cell]] = []
    for i, row in enumerate(block.rows):
        cells = []
        for name in paper.columns:
            value, quantity = row.values[name], QUANTITIES[name]
            below = published_text(value, quantity, block.same)
            cells.append(Cell(measured_text(value, quantity), block.marks.get((i, name), 0), below))
        rows.append([row.label, *cells])
    heads = [paper.head, *(QUANTITIES[name].title for name in paper.columns)]
    numeric = [False, *(True for _ in paper.columns)]
    remarks = _remarks(block) if notes else []
    return Table(_heading(block), heads, rows, numeric, remarks, "published")


def _remarks(block: Block) -> list[str]:
    """Reasons of missing values, and the meaning of marks."""
    notes = [f"{row.label}: {row.note}" for row in block.rows if row.note and row.note != NOT_MEASURED]
    if any(row.note == NOT_MEASURED for row in block.rows):
        notes.append(f"Rows with {MISSING} only: not measured here.")
    return [*notes, *block.remarks]
