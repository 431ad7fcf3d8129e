"""The page of tables, as ``python -m econgs_bench.reports.reference`` prints it and the site has it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from econgs_bench.reports.schema import COLUMNS, TABLES, Column

_TYPES = {"string": "text", "Int64": "whole number", "Float64": "number", "boolean": "true, false",
          "object": "list of numbers"}  # fmt: skip
_BETTER = {1: ", higher is better", 0: "", -1: ", lower is better"}
_HEAD = """# Tables of a run store

`python -m econgs_bench.reports.reference` prints this page from `reports/schema.py`.

`RUNS/tables/*.parquet` and a bundle's `tables/*.csv` are normalised: `jobs` holds what a job determines, and
other tables refer to it by `job`. `bench results --table NAME` and
`econgs_bench.reports.schema.read_tables(folder)` join them: every row then has the columns of its job that
are listed under *from `jobs`*. Missing values are null, empty in CSV.
"""


def page() -> str:
    """Every table with its columns, then every column with its meaning."""
    return "\n".join([_HEAD, *_tables(), *_columns()])


def _tables() -> Iterator[str]:
    for name, table in TABLES.items():
        yield f"## {name}\n\n{table.doc}\n"
        yield f"- columns: {_names(table.facts)}"
        if table.axes:
            yield f"- from `jobs`: {_names(name for name in COLUMNS if name in table.axes)}"
        yield ""


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _columns() -> Iterator[str]:
    yield "## Columns\n\n| column | type | meaning |\n|---|---|---|"
    stored = {name for table in TABLES.values() for name in table.columns}
    for column in COLUMNS.values():
        if column.name in stored:
            yield f"| `{column.name}` | {_TYPES[column.dtype]}{_unit(column)} | {_meaning(column)} |"
    yield ""


def _unit(column: Column) -> str:
    return f", {column.unit}" if column.unit else ""


def _meaning(column: Column) -> str:
    return column.doc.replace("|", "\\|") + _BETTER[column.better]


if __name__ == "__main__":
    print(page(), end="")
