"""The paper's tables as documents: Markdown, HTML, LaTeX, and text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from reports.paper.values import NOT_MEASURED, QUANTITIES, Block, PaperTable, Quantity, Value
from reports.style import MISSING
from reports.tables.documents import tex, tex_notes
from reports.tables.ranks import UNDECIDED, UNDECIDED_SIGN


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


def to_markdown(table: PaperTable) -> str:
    """A pipe table per block; best in bold, second best in italics."""
    lines, near = [f"### {table.title}"], f"{{}} {UNDECIDED_SIGN}"
    for block in table.blocks:
        lines += ["", _heading(block), ""]
        lines.append(
            f"| {table.head} | " + " | ".join(QUANTITIES[name].title for name in table.columns) + " |"
        )
        lines.append("|---|" + "---:|" * len(table.columns))
        for label, cells in _cells(table, block, {1: "**{}**", 2: "*{}*", UNDECIDED: near}, "<br>{}", str):
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
        lines += [line for text in _remarks(block) for line in ("", text)]
    return "\n".join(lines) + "\n"


def to_html(table: PaperTable) -> str:
    """A table element per block, published values small under the measured ones."""
    marks = {1: '<b class="first">{}</b>', 2: '<u class="second">{}</u>', UNDECIDED: f"{{}} {UNDECIDED_SIGN}"}
    parts = [f"<h3>{escape(table.title)}</h3>"]
    head = "".join(f'<th scope="col" class="r">{escape(QUANTITIES[n].title)}</th>' for n in table.columns)
    for block in table.blocks:
        body = "".join(
            f'<tr><th scope="row">{label}</th>' + "".join(f'<td class="r">{c}</td>' for c in cells) + "</tr>"
            for label, cells in _cells(table, block, marks, '<br><span class="soft">{}</span>', escape)
        )
        remarks = "".join(f'<p class="note">{escape(text)}</p>' for text in _remarks(block))
        parts.append(
            f'<div class="wide"><table><caption>{escape(_heading(block))}</caption>'
            f'<thead><tr><th scope="col">{escape(table.head)}</th>{head}'
            f"</tr></thead><tbody>{body}</tbody></table></div>{remarks}"
        )
    return "\n".join(parts)


def to_latex(table: PaperTable) -> str:
    """One booktabs tabular with a rule between blocks; best bold, second best underlined; notes below it."""
    lines = ["% needs \\usepackage{booktabs}", f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}"]
    lines += [
        "\\toprule",
        tex(table.head) + "".join(f" & {tex(QUANTITIES[n].title)}" for n in table.columns) + r" \\",
    ]
    marks = {1: r"\textbf{{{}}}", 2: r"\underline{{{}}}", UNDECIDED: r"{}\rlap{{$^{{\approx}}$}}"}
    for block in table.blocks:
        lines.append(r"\midrule")
        lines.append(rf"\multicolumn{{{len(table.columns) + 1}}}{{l}}{{\emph{{{tex(_heading(block))}}}}} \\")
        for i, row in enumerate(block.rows):
            cells = [
                marks.get(block.marks.get((i, name), 0), "{}").format(
                    tex(measured_text(row.values[name], QUANTITIES[name]))
                )
                for name in table.columns
            ]
            lines.append(tex(row.label) + "".join(f" & {text}" for text in cells) + r" \\")
            second = [
                published_text(row.values[name], QUANTITIES[name], block.same) for name in table.columns
            ]
            if any(second):
                small = "".join(f" & \\footnotesize {tex(text)}" if text else " &" for text in second)
                lines.append(r"\quad \footnotesize published" + small + r" \\")
    remarks: dict[str, list[str]] = {}
    for block in table.blocks:
        for text in _remarks(block):
            remarks.setdefault(text, []).append(f"{block.dataset} ({block.protocol})")
    # A remark on all blocks appears once, without their names.
    notes = [
        f"{', '.join(blocks)}: {text}" if len(blocks) < len(table.blocks) else text
        for text, blocks in remarks.items()
    ]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *tex_notes(notes)]) + "\n"


def to_text(table: PaperTable) -> str:
    """For a terminal: two lines a row, best marked with ``*`` and second best with ``+``."""
    lines = [table.title]
    for block in table.blocks:
        grid: list[list[str]] = [[table.head, *(QUANTITIES[name].title for name in table.columns)]]
        for i, row in enumerate(block.rows):
            signs = {1: "*", 2: "+", UNDECIDED: UNDECIDED_SIGN}
            values = [(row.values[name], QUANTITIES[name]) for name in table.columns]
            marks = [signs.get(block.marks.get((i, name), 0), " ") for name in table.columns]
            texts = (measured_text(*value) + mark for value, mark in zip(values, marks, strict=True))
            grid.append([row.label, *texts])
            second = [published_text(*value, block.same) for value in values]
            if any(second):
                grid.append(["  published", *(f"{text} " for text in second)])
        widths = [max(len(line[i]) for line in grid) for i in range(len(grid[0]))]
        lines += ["", _heading(block)]
        for line in grid:
            cells = [line[0].ljust(widths[0])]
            cells += [text.rjust(width) for text, width in zip(line[1:], widths[1:], strict=True)]
            lines.append("  ".join(cells).rstrip())
        lines += ["", *_remarks(block)]
    return "\n".join(lines) + "\n"


def _cells(
    table: PaperTable, block: Block, marks: Mapping[int, str], under: str, write: Any
) -> Iterator[tuple[str, list[str]]]:
    """Label and cells of each row: the measured value with its mark, and the published value under it."""
    for i, row in enumerate(block.rows):
        cells = []
        for name in table.columns:
            value, quantity = row.values[name], QUANTITIES[name]
            text = marks.get(block.marks.get((i, name), 0), "{}").format(
                write(measured_text(value, quantity))
            )
            published = published_text(value, quantity, block.same)
            cells.append(text + (under.format(write(published)) if published else ""))
        yield write(row.label), cells


def _remarks(block: Block) -> list[str]:
    """Reasons of missing values, and the meaning of marks."""
    notes = [f"{row.label}: {row.note}" for row in block.rows if row.note and row.note != NOT_MEASURED]
    if any(row.note == NOT_MEASURED for row in block.rows):
        notes.append(f"Rows with {MISSING} only: not measured here.")
    return [*notes, *block.remarks]
