"""``bench list``: names, without importing what is behind them."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable
from pathlib import Path

from econgs_bench.bench.commands.arguments import add_plugins
from econgs_bench.reports.tables.grid import Field, to_lines
from econgs_bench.reports.terminal import line_width

HEADS = {
    "methods": ("Name", "Version", "Title", "From"),
    "datasets": ("Name", "Samples", "Scenes", "Place", "Title"),
    "suites": ("Name", "Title"),
    "metrics": ("Name", "Version", "Unit", "Better"),
}
WRAPS = ("Title", "From")


def list_names_arguments(parser: ArgumentParser) -> None:
    """What ``bench list`` takes."""
    add_plugins(parser)
    parser.add_argument("what", choices=("methods", "datasets", "suites", "metrics"))


def list_names(options: Namespace) -> int:
    """Print what there is of one kind."""
    rows = {"methods": _methods, "datasets": _datasets, "suites": _suites, "metrics": _metrics}[options.what]
    columns = list(zip(HEADS[options.what], *rows(options), strict=True))
    fields = [Field(head, cells, "label" if head in WRAPS else "name") for head, *cells in columns]
    print("\n".join(to_lines(fields, line_width())))
    return 0


def _methods(options: Namespace) -> Iterable[tuple[str, ...]]:
    from econgs_bench.methods.registry import Registry

    registry = Registry(options.plugins)
    for name, reason in registry.broken.items():
        print(f"bench: {name}: {reason}", file=sys.stderr)
    return [(spec.name, spec.version, spec.title, registry.origin(spec.name)) for spec in registry]


def _datasets(options: Namespace) -> Iterable[tuple[str, ...]]:
    from econgs_bench.datasets.catalogue import list_datasets

    missing = False
    for entry in list_datasets():
        if entry.kind == "broken":
            print(f"bench: {entry.where}", file=sys.stderr)
            yield entry.name, "broken", "", "", ""
            continue
        dims = "\N{MULTIPLICATION SIGN}".join(map(str, entry.dims)) if entry.dims else ""
        if entry.kind == "procedural":
            place = "built in"
        else:
            size = f", {size_text(entry.size)}" if entry.size is not None else ""
            place = "here" if entry.available else f"fetch{size}" if entry.host else "missing"
        missing |= not entry.available
        yield (
            entry.name,
            dims or ("views" if entry.kind == "views" else ""),
            str(len(entry.scenes)),
            place,
            entry.title,
        )
    if missing:
        print(
            "bench: `bench fetch NAME` downloads sets marked fetch, and names the source of missing ones",
            file=sys.stderr,
        )


def _suites(options: Namespace) -> Iterable[tuple[str, ...]]:
    import tomllib

    # Not load_suite: its schema takes longer to import than the list to print.
    files = sorted((Path(__file__).parents[1] / "suites").glob("*.toml"))
    return [(file.stem, tomllib.loads(file.read_text(encoding="utf-8"))["title"]) for file in files]


def _metrics(options: Namespace) -> Iterable[tuple[str, ...]]:
    from econgs_bench.bench.metrics import METRICS

    return [
        (
            name,
            m.version,
            m.column.unit,
            "higher" if m.column.better > 0 else "lower",
        )
        for name, m in METRICS.items()
    ]


def size_text(count: int) -> str:
    """Bytes for people: 67 KiB, 1.2 GiB."""
    value, units = float(count), ["B", "KiB", "MiB", "GiB", "TiB"]
    while value >= 1000.0 and len(units) > 1:
        value /= 1024.0
        del units[0]
    return f"{value:.1f} {units[0]}" if units[0] != "B" and value < 10.0 else f"{value:.0f} {units[0]}"
