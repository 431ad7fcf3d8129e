"""``bench results`` and ``bench report``, and the table at the end of a run."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from econgs_bench.bench.commands.arguments import FORMATS, add_device, add_runs, add_stored
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.run.plugins import plugin_folders
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.files import write_text
from econgs_bench.reports.progress import step
from econgs_bench.reports.schema import TABLES
from econgs_bench.reports.terminal import line_width, print_prose
from econgs_bench.reports.text import one_line

_MOST_NOTES = 12

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.methods.interface import MethodSpec
    from econgs_bench.reports.report import Report
    from econgs_bench.reports.tables.grid import Field


def results_arguments(parser: ArgumentParser) -> None:
    """What ``bench results`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument("--table", choices=TABLES, default="results", help="default: results")
    parser.add_argument(
        "--format", choices=FORMATS,
        help="all columns; default: a table of those that fit into the terminal, with the jobs",
    )  # fmt: skip


def results(options: Namespace) -> int:
    """Print a table of a store."""
    from econgs_bench.reports.comparability import notes

    store = Store(Path(options.runs))
    tables = build_tables(store, current(options.plugins, store.root), write=False)
    report_damage(store)
    if options.format:
        print_as(tables[options.table], options.format, tables["views"])
    else:
        if options.table == "results":
            print_results(tables["results"], jobs=True)
        else:
            print_stored(options.table, tables[options.table])
        number = len(tables[options.table].columns)
        print(f"`bench results --format csv` prints all {number} columns.")
    if options.table not in ("differences", "superseded"):
        found = notes(tables["results"], tables["superseded"])
        _print_differences(found, tables["differences"], sys.stderr)
    return 0


def report_arguments(parser: ArgumentParser) -> None:
    """What ``bench report`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for report.html and what goes with it, or the page's name (default: the run store)",
    )
    parser.add_argument(
        "--check-claims",
        action="store_true",
        help="list the paper's claims: hold, do not, not decided, not measured; claims.csv has every check",
    )
    parser.add_argument(
        "--models",
        action="store_true",
        help="make a page of each model of Gaussians, which its rows link to; small ones inside the report",
    )
    add_device(parser)


def report(options: Namespace) -> int:
    """Print those of the paper's tables that a store has rows of, and write its HTML report."""
    from econgs_bench.reports.page.document import write_report
    from econgs_bench.reports.report import Report
    from econgs_bench.reports.sections.paper import documents, verdicts
    from econgs_bench.reports.sections.paper.tables import lacking, paper_tables

    store = Store(Path(options.runs))
    page = _page(Path(options.out)) if options.out else store.root / "report.html"
    step("making tables")
    tables = build_tables(store, current(options.plugins, store.root))
    report_damage(store)
    contents = Report(tables)
    paper = paper_tables(tables, contents.views)
    if options.check_claims:
        checked = verdicts.checked(paper, contents)
        print_prose(verdicts.to_text(checked))
        write_text(page.parent / "claims.csv", verdicts.to_csv(checked))
    for table in paper:
        print_prose(documents.to_text(table))
    if not paper and (why := lacking(tables["results"])):
        print_prose(why)
    models: dict[str, Path] = {}
    if options.models:
        from econgs_bench.bench.view.beside import write_pages

        results = tables["results"]
        jobs = results.loc[results["status"] == "ok", "job"].dropna()
        models = write_pages(
            store, jobs, page.parent, plugin_folders(options.plugins, store.root), options.device
        )
    step(f"writing {page}")
    write_report(tables, store.root, page, paper, contents, models)
    print_answers(contents)
    print(page)
    return 0


def print_answers(contents: Report) -> None:
    """Print who is best at what, who leads races, and what is not compared."""
    from econgs_bench.reports.comparability import sentences
    from econgs_bench.reports.sections.answers import contest
    from econgs_bench.reports.sections.answers.conclusion import to_text
    from econgs_bench.reports.sections.order import answers, family
    from econgs_bench.reports.sections.races import conclusion as races

    if found := contest.of_report(contents):
        print_prose("\n".join(to_text(found[0], answers(contents))))
    elif contents.results["method"].nunique() > 1:
        print_prose(
            "Nothing is ranked: no two methods have the same scenes under the same conditions, each with its "
            "default options."
        )
    for sentence in races.conclusion(races.of_report(contents), family(contents)):
        print_prose(sentence)
    _print_differences(sentences(contents.remarks), contents.stored["differences"], sys.stdout)


def report_damage(store: Store) -> None:
    """Name the damaged records of a store whose records were read, if there are any."""
    if store.damaged:
        (name, reason), *others = store.damaged.items()
        more = f", and {len(others)} more" if others else ""
        text = f"{store.jobs / name}: {reason}{more}. `bench repair --runs {store.root}` sets them aside"
        print(f"bench: damaged record left out: {text}", file=sys.stderr)


def _print_differences(remarks: Sequence[str], listed: pd.DataFrame, out: TextIO) -> None:
    """Print what is not compared, and the command that lists it; nothing where everything is."""
    for remark in remarks[:_MOST_NOTES]:
        print_prose(remark, out)
    if len(remarks) > _MOST_NOTES:
        print(f"... and {len(remarks) - _MOST_NOTES} more remarks.", file=out)
    if not listed.empty:
        print("`bench results --table differences` lists what is not compared.", file=out)


def _page(out: Path) -> Path:
    """The page that ``--out`` names, or report.html in the folder that it names."""
    path = out if out.suffix == ".html" else out / "report.html"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DataError(path.parent, "is not a folder", "Name another folder, or a page (x.html)") from None
    return path


def print_as(table: pd.DataFrame, form: str, views: pd.DataFrame | None = None) -> None:
    """Write a table to standard output as csv, md, tex or json; views tell which values are level."""
    if form == "csv":
        from econgs_bench.reports.tables.documents import to_csv

        sys.stdout.write(to_csv(table))
    elif form == "json":
        from econgs_bench.reports.tables.documents import to_json

        sys.stdout.write(to_json(table))
    else:
        from econgs_bench.reports.statistics import Views
        from econgs_bench.reports.tables import documents
        from econgs_bench.reports.tables.protocols import by_protocol
        from econgs_bench.reports.tables.ranks import ranks

        writer: Any = documents.to_markdown if form == "md" else documents.to_latex
        shown = by_protocol({"results": table})["results"]
        print(writer(shown, ranks(shown, Views(views))))


def print_results(table: pd.DataFrame, *, jobs: bool = False) -> None:
    """The rows of a run, for people; with their jobs, which ``bench render --model`` takes."""
    from econgs_bench.reports.tables.protocols import by_protocol
    from econgs_bench.reports.tables.results import for_terminal

    _print_shared(*for_terminal(by_protocol({"results": table})["results"], line_width(), jobs=jobs))


def print_stored(name: str, table: pd.DataFrame) -> None:
    """Any table of a run store, for people."""
    from econgs_bench.reports.tables.results import stored_for_terminal

    _print_shared(*stored_for_terminal(name, table, line_width()))


def _print_shared(shared: str, fields: list[Field]) -> None:
    """A table below what all of its rows share."""
    if shared:
        print(one_line(shared))
    print_grid(fields)


def print_table(table: pd.DataFrame) -> None:
    """A table made for people; columns that hold nothing are left out."""
    from econgs_bench.reports.tables.results import fitted

    names = [name for name in table.columns if table[name].replace("", None).notna().any()]
    _print_shared(*fitted(table, table[names], (), (), line_width()))


def print_grid(fields: Sequence[Field]) -> None:
    """Columns for people."""
    from econgs_bench.reports.tables.grid import to_lines

    for line in to_lines(
        [each._replace(cells=list(map(one_line, each.cells))) for each in fields], line_width()
    ):
        print(line)


def current(plugins: Iterable[str], *stores: Path) -> dict[str, MethodSpec]:
    """Method -> its spec of today, plugins included."""
    from econgs_bench.methods.registry import Registry

    return Registry(plugin_folders(plugins, *stores)).specs
