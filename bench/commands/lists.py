"""``bench list``: names, without importing what is behind them."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.bench.commands.arguments import add_plugins
from econgs_bench.reports.tables.grid import Field, to_lines
from econgs_bench.reports.terminal import line_width

if TYPE_CHECKING:
    from econgs_bench.bench.metrics import Metric

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
    parser.add_argument("what", choices=tuple(HEADS))
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help="what is known of these: a method's paper and options, a dataset's scenes, a suite's choices",
    )


def list_names(options: Namespace) -> int:
    """Print what there is of one kind, or what is known of some of it."""
    if options.names:
        return _describe(options)
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
    return [(name, _read_suite(file)["title"]) for name, file in _suite_files().items()]


def _suite_files() -> dict[str, Path]:
    return {file.stem: file for file in sorted((Path(__file__).parents[1] / "suites").glob("*.toml"))}


def _read_suite(file: Path) -> dict[str, Any]:
    """As it is written: the schema of load_suite takes longer to import than a list to print."""
    import tomllib

    return tomllib.loads(file.read_text(encoding="utf-8"))


def _metrics(options: Namespace) -> Iterable[tuple[str, ...]]:
    from econgs_bench.bench.metrics import METRICS

    return [(name, m.version, m.column.unit, _better(m)) for name, m in METRICS.items()]


def _better(metric: Metric) -> str:
    return "higher" if metric.column.better > 0 else "lower"


def _describe(options: Namespace) -> int:
    """Print facts of each name, and its options."""
    known = {"methods": _method, "datasets": _dataset, "suites": _suite, "metrics": _metric}[options.what]
    described = [known(options, name) for name in options.names]
    for number, (name, (facts, table)) in enumerate(zip(options.names, described, strict=True)):
        heads, texts = zip(*[("Name", name), *((head, text) for head, text in facts if text)], strict=True)
        fields = [Field("", list(heads), "name"), Field("", list(texts))]
        print("\n".join(([""] if number else []) + to_lines(fields, line_width())[1:]))
        if table:
            columns = zip(("Option", "Default", "Values", "Meaning"), *table, strict=True)
            fields = [Field(head, cells, "name" if head == "Option" else "label") for head, *cells in columns]
            print("\n".join(["", *to_lines(fields, line_width())]))
    return 0


_Facts = tuple[list[tuple[str, str]], list[tuple[str, ...]]]
"""Names and texts, and a table of options."""


def _method(options: Namespace, name: str) -> _Facts:
    from econgs_bench.methods.reference import options_of, settings_of
    from econgs_bench.methods.registry import Registry

    registry = Registry(options.plugins)
    spec = registry.spec(name)
    facts = [
        ("Version", spec.version),
        ("Title", spec.title),
        ("From", registry.origin(name)),
        ("Paper", spec.reference),
        ("Alpha of views", spec.uses_alpha),
        ("Edits", ", ".join(sorted(spec.edits))),
        ("Devices", ", ".join(spec.devices)),
        *((what[:1].upper() + what[1:], text) for what, text in _plain(settings_of(spec))),
    ]
    return facts, list(_plain(options_of(spec)))


def _dataset(options: Namespace, name: str) -> _Facts:
    from econgs_bench.datasets.catalogue import list_datasets
    from econgs_bench.datasets.catalogue.entries import entry
    from econgs_bench.datasets.names import unknown

    infos = {info.name: info for info in list_datasets()}
    if name not in infos:
        raise unknown("dataset", name, infos)
    info = infos[name]
    if info.kind == "broken":
        return [("Broken", info.where)], []
    source = entry(name).get("acknowledgement", "")
    scenes = ", ".join(info.scenes)
    return [("Title", info.title), ("Scenes", scenes), ("Place", info.where), ("Source", source)], []


def _suite(options: Namespace, name: str) -> _Facts:
    from econgs_bench.datasets.names import unknown

    files = _suite_files()
    if name not in files:
        raise unknown("suite", name, files)
    table = _read_suite(files[name])
    kept = ("title", "preset", "seeds", "methods", "optional", "datasets")
    facts = {key: table[key] for key in kept if key in table}
    return [(key.capitalize(), _joined(value)) for key, value in facts.items()], []


def _metric(options: Namespace, name: str) -> _Facts:
    from econgs_bench.bench.metrics import METRICS
    from econgs_bench.datasets.names import unknown

    if name not in METRICS:
        raise unknown("metric", name, METRICS)
    metric = METRICS[name]
    facts = [("Version", metric.version), ("Unit", metric.column.unit), ("Better", _better(metric))]
    return [*facts, ("Meaning", metric.column.doc)], []


def _plain(rows: Iterable[tuple[str, ...]]) -> Iterable[tuple[str, ...]]:
    """Markdown's marks of code are none in a terminal."""
    return [tuple(text.replace("`", "") for text in row) for row in rows]


def _joined(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | dict) else str(value)


def size_text(count: int) -> str:
    """Bytes for people: 67 KiB, 1.2 GiB."""
    value, units = float(count), ["B", "KiB", "MiB", "GiB", "TiB"]
    while value >= 1000.0 and len(units) > 1:
        value /= 1024.0
        del units[0]
    return f"{value:.1f} {units[0]}" if units[0] != "B" and value < 10.0 else f"{value:.0f} {units[0]}"
