"""The paper's tables as documents: Markdown, HTML, LaTeX, and text for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from html import escape

from econgs_bench.reports.paper.values import NOT_MEASURED, QUANTITIES, Block, PaperTable, Quantity, Value
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.documents import MARKDOWN_MARKS, TEX_MARKS, tex, tex_notes
from econgs_bench.reports.tables.ranks import UNDECIDED, UNDECIDED_SIGN
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


def to_markdown(table: PaperTable) -> str:
    """A pipe table per block; best in bold, second best in italics."""
    lines = [f"### {markdown_cell(table.title)}"]
    for block in table.blocks:
        heads = " | ".join(map(markdown_cell, _heads(table)))
        lines += ["", markdown_cell(_heading(block)), "", f"| {heads} |"]
        lines.append("|---|" + "---:|" * len(table.columns))
        for label, measured, published in _rows(table, block, MARKDOWN_MARKS, markdown_cell):
            cells = (f"{m}<br>{p}" if p else m for m, p in zip(measured, published, strict=True))
            lines.append(f"| {' | '.join([label, *cells])} |")
        lines += [line for text in _remarks(block) for line in ("", markdown_cell(text))]
    return "\n".join(lines) + "\n"


def to_html(table: PaperTable) -> str:
    """A table element per block, with small published values below the measured ones."""
    marks = {1: '<b class="first">{}</b>', 2: '<u class="second">{}</u>', UNDECIDED: f"{{}} {UNDECIDED_SIGN}"}
    parts = [f"<h3>{escape(table.title)}</h3>"]
    first, *others = map(escape, _heads(table))
    head = f'<th scope="col">{first}</th>' + "".join(f'<th scope="col" class="r">{h}</th>' for h in others)
    for block in table.blocks:
        body = ""
        for label, measured, published in _rows(table, block, marks, escape):
            cells = "".join(
                f'<td class="r">{m}' + (f'<br><span class="soft">{p}</span>' if p else "") + "</td>"
                for m, p in zip(measured, published, strict=True)
            )
            body += f'<tr><th scope="row">{label}</th>{cells}</tr>'
        remarks = "".join(f'<p class="note">{escape(text)}</p>' for text in _remarks(block))
        parts.append(
            f'<div class="wide"><table><caption>{escape(_heading(block))}</caption>'
            f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{remarks}"
        )
    return "\n".join(parts)


def to_latex(table: PaperTable) -> str:
    """One booktabs tabular with a rule between blocks; best bold, second best underlined; notes below it."""
    lines = ["% needs \\usepackage{booktabs}", f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}"]
    lines += ["\\toprule", " & ".join(map(tex, _heads(table))) + r" \\"]
    remarks: dict[str, list[str]] = {}
    for block in table.blocks:
        lines.append(r"\midrule")
        lines.append(rf"\multicolumn{{{len(table.columns) + 1}}}{{l}}{{\emph{{{tex(_heading(block))}}}}} \\")
        for label, measured, published in _rows(table, block, TEX_MARKS, tex):
            lines.append(" & ".join([label, *measured]) + r" \\")
            if any(published):
                small = "".join(rf" & \footnotesize {text}" if text else " &" for text in published)
                lines.append(r"\quad \footnotesize published" + small + r" \\")
        for text in _remarks(block):
            remarks.setdefault(text, []).append(f"{block.dataset} ({block.protocol})")
    # A remark on all blocks appears once, without their names.
    notes = [
        f"{', '.join(blocks)}: {text}" if len(blocks) < len(table.blocks) else text
        for text, blocks in remarks.items()
    ]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *tex_notes(notes)]) + "\n"


def to_text(table: PaperTable) -> str:
    """Text for a terminal: two lines a row; ``*`` marks the best and ``+`` the second best value."""
    marks = {0: "{} ", 1: "{}*", 2: "{}+", UNDECIDED: f"{{}}{UNDECIDED_SIGN}"}
    lines = [table.title]
    for block in table.blocks:
        grid = [_heads(table)]
        for label, measured, published in _rows(table, block, marks, str):
            grid.append([label, *measured])
            if any(published):
                grid.append(["  published", *(f"{text} " for text in published)])
        widths = [max(len(line[i]) for line in grid) for i in range(len(grid[0]))]
        lines += ["", _heading(block)]
        for first, *others in grid:
            cells = [text.rjust(width) for text, width in zip(others, widths[1:], strict=True)]
            lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
        lines += ["", *_remarks(block)]
    return "\n".join(lines) + "\n"


def _heads(table: PaperTable) -> list[str]:
    return [table.head, *(QUANTITIES[name].title for name in table.columns)]


def _rows(
    table: PaperTable, block: Block, marks: Mapping[int, str], write: Callable[[str], str]
) -> Iterator[tuple[str, list[str], list[str]]]:
    """Label, measured values with their marks, and published values of each row."""
    for i, row in enumerate(block.rows):
        measured, published = [], []
        for name in table.columns:
            value, quantity = row.values[name], QUANTITIES[name]
            mark = marks.get(block.marks.get((i, name), 0), "{}")
            measured.append(mark.format(write(measured_text(value, quantity))))
            published.append(write(published_text(value, quantity, block.same)))
        yield write(row.label), measured, published


def _remarks(block: Block) -> list[str]:
    """Reasons of missing values, and the meaning of marks."""
    notes = [f"{row.label}: {row.note}" for row in block.rows if row.note and row.note != NOT_MEASURED]
    if any(row.note == NOT_MEASURED for row in block.rows):
        notes.append(f"Rows with {MISSING} only: not measured here.")
    return [*notes, *block.remarks]
