"""``python -m econgs_bench.reports --table results.csv --out DIR``: a report from a table of any tool."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from econgs_bench.reports.inputs import NEEDED, Unusable, read_results
from econgs_bench.reports.terminal import terminal
from econgs_bench.reports.text import one_line


def main(arguments: list[str] | None = None) -> int:
    """Write the page, charts and tables; returns 0, or 2 for an unusable input or output."""
    with terminal() as streams:
        code = _run(arguments)
    return streams.code(code)


def _run(arguments: list[str] | None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m econgs_bench.reports", description="A report of a table of results."
    )
    columns = ", ".join(NEEDED)
    parser.add_argument(
        "--table", type=Path, required=True, help=f"CSV or Parquet file with at least {columns}"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for report.html and its files")
    options = parser.parse_args(arguments)
    try:
        tables = read_results(options.table)
    except Unusable as error:
        print(f"error: {one_line(str(error))}", file=sys.stderr)
        return 2
    from econgs_bench.reports.page.document import write_report

    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"the folder cannot be created ({error.strerror}); name another with --out"
        print(f"error: {one_line(str(options.out))}: {reason}", file=sys.stderr)
        return 2
    print(write_report(tables, options.table.parent, options.out / "report.html"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
