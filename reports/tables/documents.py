"""Tables of the schema as documents: CSV, and for people Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.comparability import left_out
from econgs_bench.reports.schema import by_name
from econgs_bench.reports.style import absent, row_label
from econgs_bench.reports.tables import table as tables
from econgs_bench.reports.tables.columns import cell, is_results
from econgs_bench.reports.tables.ranks import UNDECIDED_NOTE, ranks
from econgs_bench.reports.tables.results import marked, with_notes
from econgs_bench.reports.tables.table import UNDECIDED, Cell, Table
from econgs_bench.reports.text import csv_cell

if TYPE_CHECKING:
    import pandas as pd

Marks = Mapping[tuple[Any, str], int]
"""(row index, column) -> place."""


def to_json(table: pd.DataFrame) -> str:
    """All columns as a JSON list of rows, numbers in full."""
    return f"{table.to_json(orient='records', indent=1, double_precision=15)}\n"


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
    shown = _table(table, marks, remark)
    return tables.to_markdown(replace(shown, notes=[*shown.notes, *_undecided(shown)]))


def to_latex(table: pd.DataFrame, marks: Marks | None = None, remark: str = "") -> str:
    """A booktabs table; the best value bold, the second underlined. `results` is cut to :func:`display`.

    `results` is a longtable, which breaks across pages; any other table is a tabular. Arguments as of
    :func:`to_markdown`.
    """
    results = is_results(table)
    shown = _table(table, marks, remark, "reason" if results else "")
    notes = [*_undecided(shown), *(_unfinished(table) if results else []), *shown.notes]
    return tables.to_latex([replace(shown, notes=notes)], long=results)


def _table(table: pd.DataFrame, marks: Marks | None, remark: str, without: str = "") -> Table:
    """A table for people; what is left out of comparisons is in brackets."""
    marks = ranks(table) if marks is None else marks
    out = left_out(table)
    table, notes = with_notes(table)
    names = [name for name in table.columns if name != without]
    columns = [[cell(name, value) for value in table[name].tolist()] for name in names]
    rows = [
        [
            Cell(marked(text, (index, name) in out), marks.get((index, name), 0))
            for name, text in zip(names, texts, strict=True)
        ]
        for index, *texts in zip(table.index, *columns, strict=True)
    ]
    heads = [by_name(name) for name in names]
    numeric = [head.numeric for head in heads]
    return Table("", [head.header for head in heads], rows, numeric, [*notes, *([remark] if remark else [])])


def _undecided(table: Table) -> list[str]:
    signs = {each.mark for row in table.rows for each in row if isinstance(each, Cell)}
    return [UNDECIDED_NOTE] if UNDECIDED in signs else []


def _unfinished(results: pd.DataFrame) -> list[str]:
    """Each unfinished row with its reason."""
    return [
        f"{row['dataset']}, {row['scene']}, {row_label(row)}: "
        f"{row['status']}{'' if absent(row['reason']) else f' ({row.reason})'}"
        for _, row in results[results["status"] != "ok"].iterrows()
    ]
