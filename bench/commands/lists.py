"""``bench list``: names, without importing what is behind them."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterable


def list_names(options: Namespace) -> int:
    """Print what there is of one kind."""
    rows = {"methods": _methods, "datasets": _datasets, "suites": _suites, "metrics": _metrics}[options.what]
    _print(rows(options))
    return 0


def _methods(options: Namespace) -> Iterable[tuple[str, ...]]:
    from methods.registry import Registry

    registry = Registry(options.plugins)
    for name, reason in registry.broken.items():
        print(f"bench: {name}: {reason}", file=sys.stderr)
    return [(spec.name, spec.version, spec.title, registry.origin(spec.name)) for spec in registry]


def _datasets(options: Namespace) -> Iterable[tuple[str, ...]]:
    from datasets.catalogue import list_datasets

    for entry in list_datasets():
        if entry.kind == "broken":
            yield entry.name, "broken", "", entry.where, ""
            continue
        size = "\N{MULTIPLICATION SIGN}".join(map(str, entry.dims)) if entry.dims else ""
        yield (
            entry.name,
            size or ("views" if entry.kind == "views" else ""),
            "1 scene" if len(entry.scenes) == 1 else f"{len(entry.scenes)} scenes",
            entry.title,
            "" if entry.available else "(no data: set BENCH_DATA)",
        )


def _suites(options: Namespace) -> Iterable[tuple[str, ...]]:
    from bench.suites import load_suite, names

    return [(name, load_suite(name).title) for name in names()]


def _metrics(options: Namespace) -> Iterable[tuple[str, ...]]:
    from bench.metrics import METRICS

    return [
        (
            name,
            f"version {m.version}",
            m.column.unit,
            "higher is better" if m.column.better > 0 else "lower is better",
        )
        for name, m in METRICS.items()
    ]


def _print(rows: Iterable[tuple[str, ...]]) -> None:
    """Columns as wide as their widest cell."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))] if cells else []
    for row in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
