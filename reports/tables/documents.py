"""Tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from reports.schema import by_name
from reports.style import MISSING, absent, label
from reports.tables.columns import cell, is_results
from reports.tables.ranks import UNDECIDED, UNDECIDED_NOTE, UNDECIDED_SIGN, ranks
from reports.tables.results import readable

if TYPE_CHECKING:
    import pandas as pd


def to_csv(table: pd.DataFrame) -> str:
    """All columns with raw values; missing is empty.

    Numbers are written as Python does: NumPy's text has fewer digits once any library in the process has set
    its print options (colour-science does).
    """
    import pandas as pd

    plain = table.copy()
    for name in plain.columns:
        if plain[name].dtype.kind == "f":
            values = [None if absent(value) else float(value) for value in plain[name]]
            plain[name] = pd.Series(values, plain.index, dtype=object)
    return plain.to_csv(index=False, lineterminator="\n")


def to_markdown(table: pd.DataFrame, views: pd.DataFrame | None = None, remark: str = "") -> str:
    """A pipe table; the best value in bold, the second in italics. `results` is cut to what people read.

    Args:
        table: `results` or any other.
        views: what :func:`ranks` asks.
        remark: to stand under it, besides those that follow from its rows.
    """
    marks = ranks(table, views)
    table, remarks = readable(table)
    remarks += [remark] if remark else []
    lines = ["| " + " | ".join(_md(by_name(name).header) for name in table.columns) + " |"]
    lines.append("|" + "|".join("---:" if by_name(name).numeric else "---" for name in table.columns) + "|")
    for index, row in table.iterrows():
        texts = []
        for name in table.columns:
            mark = marks.get((index, name), 0)
            sign = {1: "**", 2: "*"}.get(mark, "")
            near = f" {UNDECIDED_SIGN}" if mark == UNDECIDED else ""
            texts.append(f"{sign}{_md(cell(name, row[name]))}{sign}{near}")
        lines.append("| " + " | ".join(texts) + " |")
    if UNDECIDED in marks.values():
        remarks.append(UNDECIDED_NOTE)
    lines += [f"\n{_md(remark)}" for remark in remarks]
    return "\n".join(lines) + "\n"


def to_latex(table: pd.DataFrame, views: pd.DataFrame | None = None, remark: str = "") -> str:
    """With booktabs; the best value bold, the second underlined. `results` is cut to what is read.

    `results` becomes a longtable, which breaks across pages, any other table a tabular.

    Args:
        table: `results` or any other.
        views: what :func:`ranks` asks.
        remark: to stand under it, besides those that follow from its rows.
    """
    marks = ranks(table, views)
    results = is_results(table)
    notes = [UNDECIDED_NOTE] if UNDECIDED in marks.values() else []
    notes += _unfinished(table) if results else []
    table, remarks = readable(table)
    notes += [*remarks, *([remark] if remark else [])]
    if results:
        table = table.drop(columns="reason", errors="ignore")
    spec = "".join("r" if by_name(name).numeric else "l" for name in table.columns)
    head = [
        r"\toprule",
        " & ".join(tex(by_name(name).header) for name in table.columns) + r" \\",
        r"\midrule",
    ]
    if results:
        lines = [r"% needs \usepackage{booktabs,longtable}; wide: landscape, small type"]
        lines += [rf"\begin{{longtable}}{{{spec}}}", *head, r"\endhead", r"\bottomrule", r"\endfoot"]
    else:
        lines = [r"% needs \usepackage{booktabs}", rf"\begin{{tabular}}{{{spec}}}", *head]
    for index, row in table.iterrows():
        texts = []
        for name in table.columns:
            text = tex(cell(name, row[name]))
            mark = marks.get((index, name), 0)
            if mark == UNDECIDED:
                text += r"\rlap{$^{\approx}$}"  # takes no width, so the digits stay aligned
            macro = {1: "textbf", 2: "underline"}.get(mark)
            texts.append(f"\\{macro}{{{text}}}" if macro else text)
        lines.append(" & ".join(texts) + r" \\")
    lines += [r"\end{longtable}"] if results else [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*lines, *tex_notes(notes)]) + "\n"


def _unfinished(results: pd.DataFrame) -> list[str]:
    """Of each row that did not finish, why."""
    return [
        f"{row['dataset']}, {row['scene']}, {label(row['method'], row['variant'], row['rate'])}: "
        f"{row['status']}{'' if absent(row['reason']) else f' ({row.reason})'}"
        for _, row in results[results["status"] != "ok"].iterrows()
    ]


def tex_notes(notes: Iterable[str]) -> list[str]:
    """What stands below a LaTeX table, a paragraph each."""
    return [rf"\par\noindent{{\footnotesize {tex(note)}\par}}" for note in notes]


def _md(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("\n", " ")


_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\n": " ", "Δ": r"$\Delta$",
    "±": r"$\pm$", MISSING: "--",
    "\N{MINUS SIGN}": "$-$",
    "*": r"$^{*}$", UNDECIDED_SIGN: r"$\approx$", "\N{MULTIPLICATION SIGN}": r"$\times$",
}  # fmt: skip


def tex(text: str) -> str:
    """Text with what LaTeX would take for commands escaped."""
    return "".join(_TEX.get(sign, sign) for sign in text)
