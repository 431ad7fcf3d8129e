"""``bench merge``, ``compare``, ``bundle``, ``verify``, ``repair`` and ``cache``."""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from econgs_bench.bench.commands.arguments import (
    FORMATS,
    add_limits,
    add_plugins,
    add_runs,
    add_stored,
    byte_size,
    count,
    repeatable,
)
from econgs_bench.bench.commands.results import current, report_damage
from econgs_bench.bench.results.comparison import compared
from econgs_bench.bench.results.rungs import ladders_of
from econgs_bench.bench.results.rungs import remember as remember_ladders
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.run.plugins import remember, resolved
from econgs_bench.bench.store.joining import join
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.reports.progress import step


def merge_arguments(parser: ArgumentParser) -> None:
    """What ``bench merge`` takes."""
    add_stored(parser)
    parser.add_argument("stores", nargs="+", metavar="STORE|BUNDLE")
    parser.add_argument("--out", required=True, metavar="DIR", help="a new run store, or one to add to")


def merge(options: Namespace) -> int:
    """Join stores and bundles: a job finished in one is finished in all; a success goes before a failure."""
    from econgs_bench.bench.results.bundle import unpacked

    with ExitStack() as stack:
        step("checking what is to be joined")
        paths = [Path(name) for name in options.stores]
        sources = [stack.enter_context(unpacked(path)) if path.is_file() else Store(path) for path in paths]
        return _merge(sources, options)


def _merge(sources: list[Store], options: Namespace) -> int:
    target = Store(Path(options.out), create=True)
    taken = kept = 0
    for source in sources:
        if source.root == target.root:
            raise DataError(source.root, "is the target itself", "Name the other stores only")
        step(f"joining the jobs of {source.root}")
        new, there = join(source, target)
        taken, kept = taken + new, kept + there
    for source in sources:
        remember_ladders(target, ladders_of(source.root))
        report_damage(source)
    remember(target, resolved(options.plugins))
    folders = [Path(name) for name in options.stores if Path(name).is_dir()]
    step("making tables")
    build_tables(target, current(options.plugins, target.root, *folders))
    print(f"{target.root}: {taken} jobs taken, {kept} there already")
    return 0


def compare_arguments(parser: ArgumentParser) -> None:
    """What ``bench compare`` takes."""
    parser.add_argument("stores", nargs=2, metavar="RUN")
    parser.add_argument("--format", choices=FORMATS, help="default: a table for people")


def compare(options: Namespace) -> int:
    """Pair two stores view by view: mean of each metric in both, and how the views differ."""
    step("making tables of both")
    first, second = (build_tables(Store(Path(root)), write=False)["views"] for root in options.stores)
    table = compared(first, second)
    for line in table.attrs["differences"]:
        print(f"bench: {line}", file=sys.stderr)
    if table.empty:
        raise DataError(
            f"{options.stores[0]} and {options.stores[1]}",
            "have no view in common (same dataset, scene, method, variant, rate, preset, split, "
            "training views and seed, and the same truth)",
            "Compare runs of the same selection",
        )
    if options.format:
        from econgs_bench.bench.commands.results import print_as

        print_as(table, options.format)
    else:
        from econgs_bench.bench.commands.results import print_table

        print_table(table)
        print("difference: second - first, mean over the paired views; least and greatest of any view")
    alone = (len(first) - table.attrs["views"], len(second) - table.attrs["views"])
    if any(alone):
        print(
            f"bench: not paired: {alone[0]} views of the first run, {alone[1]} of the second", file=sys.stderr
        )
    return 0


def cache_arguments(parser: ArgumentParser) -> None:
    """What ``bench cache`` takes."""
    parser.add_argument("action", choices=("info", "prune"))
    parser.add_argument(
        "--max-size", type=byte_size, metavar="SIZE", help="prune to this size (default: its cap)"
    )


def cache(options: Namespace) -> int:
    """Tell what the ground-truth cache takes, or shrink it."""
    from econgs_bench.datasets.view_cache import ViewCache

    views = ViewCache()
    if options.action == "prune":
        freed = views.prune(options.max_size or views.max_bytes)
        print(f"freed {freed / 2**20:.1f} MiB")
    print(f"{views.folder}: {views.size() / 2**20:.1f} MiB of at most {views.max_bytes / 2**30:.0f} GiB")
    return 0


def bundle_arguments(parser: ArgumentParser) -> None:
    """What ``bench bundle`` takes."""
    add_runs(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="NAME.zip, or NAME.zip.xz: smaller")
    parser.add_argument("--models", action="store_true", help="with the encoded models")


def bundle(options: Namespace) -> int:
    """Write a submission bundle of a store."""
    from econgs_bench.bench.results.bundle import write_bundle

    out, store = Path(options.out), Store(Path(options.runs))
    step(f"packing {store.root}")
    count = write_bundle(store, out, models=options.models)
    report_damage(store)
    print(f"{out}: {count} records, {out.stat().st_size / 2**20:.1f} MiB")
    return 0


def repair_arguments(parser: ArgumentParser) -> None:
    """What ``bench repair`` takes."""
    add_runs(parser)


def repair(options: Namespace) -> int:
    """Set the damaged records of a store aside, so that their jobs run again."""
    store = Store(Path(options.runs))
    count = sum(1 for _ in store.records())
    for name, reason in list(store.damaged.items()):
        print(f"{store.set_aside(name)}: {reason}")
    print(f"{store.root}: {count} records are whole, {len(store.damaged)} were set aside")
    return 0


def verify_arguments(parser: ArgumentParser) -> None:
    """What ``bench verify`` takes."""
    add_plugins(parser)
    parser.add_argument("bundle", metavar="FILE")
    parser.add_argument(
        "--redo", type=count, default=0, metavar="N",
        help="decode N models and measure them in views that the bundle's hash chooses; 2: not possible here",
    )  # fmt: skip
    repeatable(parser, "--dataset", metavar="PATH", help="data that the catalogue lacks, for --redo")
    add_limits(parser)


def verify(options: Namespace) -> int:
    """Check a bundle: 0 all of it holds, 1 something does not, 2 models could not be measured here."""
    from econgs_bench.bench.results.bundle import unpack

    path = Path(options.bundle)
    step(f"checking {path}")
    with tempfile.TemporaryDirectory() as folder:
        verdict = unpack(path, Path(folder))
        _print_lines(verdict.problems)
        _print_lines([f"note: {note}" for note in verdict.notes])
        if verdict.problems or not options.redo:
            return _conclude(path, len(verdict.problems), "all of it holds")
        from econgs_bench.bench.run.limits import Limits
        from econgs_bench.bench.run.redo import redo

        step(f"measuring {options.redo} models again")
        redone = redo(
            Store(Path(folder)), path, options.redo, datasets=options.dataset, plugins=options.plugins,
            limits=Limits(options.time_limit, options.memory_limit),
        )  # fmt: skip
    for job, views in redone.views.items():
        print(f"{job}: measured again in the views {', '.join(views)}")
    _print_lines(redone.problems)
    _print_lines([f"not verified: {line}" for line in redone.unverified])
    if redone.unverified and not redone.problems:
        print(f"{path}: the records hold, but not all that was asked for could be measured again")
        return 2
    return _conclude(path, len(redone.problems), "all of it holds, the models that were drawn too")


def _print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        print(f"bench: {printable(line)}", file=sys.stderr)


def _conclude(path: Path, problems: int, whole: str) -> int:
    print(f"{path}: {f'{problems} problems' if problems else whole}")
    return 1 if problems else 0
