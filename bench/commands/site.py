"""``bench site``."""

from __future__ import annotations

import hashlib
from argparse import ArgumentParser, Namespace
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from econgs_bench.bench.commands.arguments import add_limits, add_plugins, count, repeatable
from econgs_bench.bench.commands.results import current
from econgs_bench.bench.results.bundle import unpacked
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.run.limits import Limits
from econgs_bench.bench.run.redo import redo
from econgs_bench.bench.store.joining import join
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import VIEWS
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step


def site_arguments(parser: ArgumentParser) -> None:
    """What ``bench site`` takes."""
    add_plugins(parser)
    parser.add_argument("bundles", nargs="+", metavar="BUNDLE", help="that `bench bundle` wrote")
    parser.add_argument("--out", required=True, metavar="DIR", help="a new site, or one to add to")
    parser.add_argument("--title", default="Results", help="of the first page")
    parser.add_argument(
        "--redo", type=count, default=0, metavar="N", help="decode N models of each and measure them again"
    )
    repeatable(parser, "--dataset", metavar="PATH", help="data that the catalogue lacks, for --redo")
    add_limits(parser)


def site(options: Namespace) -> int:
    """Write a static site of bundles; a bundle that does not hold stops it before anything is written."""
    from econgs_bench.reports.site import Submission, write_site

    views = {name: preset.train_views for name, preset in VIEWS.items()}
    specs = current(options.plugins)
    with ExitStack() as stack:
        store = Store(Path(stack.enter_context(TemporaryDirectory())) / "store", create=True)
        submissions = []
        for path in map(Path, options.bundles):
            step(f"checking {path}")
            own = stack.enter_context(unpacked(path))
            tables = build_tables(own, specs, write=False)
            results = tables["results"]
            if results.empty:
                raise DataError(path, "holds no results", "Leave it out")
            redone = _redone(own, path, options) if options.redo else 0
            join(own, store)

            def names(column: str, results=results) -> tuple[str, ...]:  # type: ignore[no-untyped-def]
                return tuple(sorted(map(str, results[column].dropna().unique())))

            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            one = Submission(
                name=path.stem, sha256=digest, added=datetime.now(UTC).isoformat(timespec="seconds"),
                records=sum(1 for _ in own.records()), redone=redone,
                first=str(results["finished"].min()), last=str(results["finished"].max()),
                machines=names("processor"), commits=names("commit"),
                seeds=tuple(sorted(map(int, results["seed"].dropna().unique()))),
                methods=names("method"), datasets=names("dataset"),
            )  # fmt: skip
            submissions.append((one, tables))
        step("writing the pages")
        print(
            write_site(
                Path(options.out), options.title, build_tables(store, specs, write=False), submissions, views
            )
        )
    return 0


def _redone(store: Store, path: Path, options: Namespace) -> int:
    """Number of models that were measured again and agree."""
    step(f"measuring {options.redo} models of {path} again")
    found = redo(
        store, path, options.redo, datasets=options.dataset, plugins=options.plugins,
        limits=Limits(options.time_limit, options.memory_limit),
    )  # fmt: skip
    if found.problems:
        raise DataError(
            path, f"does not hold: {found.problems[0]}", "`bench verify --redo` lists what is wrong"
        )
    return len(found.views)
