"""``bench baseline`` and ``bench gate``."""

from __future__ import annotations

import platform
import sys
from argparse import ArgumentParser, Namespace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.datasets.errors import DataError

ERROR = 3
"""Exit code of a baseline or store that cannot be read, or of files that cannot be written."""


def baseline_arguments(parser: ArgumentParser) -> None:
    """What ``bench baseline`` takes."""
    parser.add_argument("store", nargs="?", default="runs", metavar="STORE", help="default: runs")
    parser.add_argument("--out", required=True, metavar="FILE", help="the baseline, new or to update")
    parser.add_argument("--reason", required=True, help="why its results are what is expected from now on")


def baseline(options: Namespace) -> int:
    """Write the results of a store as a baseline, or update one: what the store lacks stays."""
    from econgs_bench.bench.gate import baseline as files
    from econgs_bench.bench.gate.cells import cells_of
    from econgs_bench.bench.machine.provenance import commit_here
    from econgs_bench.bench.results.tables import build_tables
    from econgs_bench.reports.style import counted

    path = Path(options.out)
    earlier = files.read(path) if path.exists() else None
    store = Store(Path(options.store))
    cells = cells_of(store, build_tables(store, write=False))
    if not cells:
        raise DataError(
            store.root, "holds no results", "Run a suite first: bench run gate --seed 0 --seed 1 --seed 2"
        )
    change = files.Change(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        reason=options.reason,
        version=version("econgs-bench"),
        commit=commit_here(),
    )
    environment = {"python": platform.python_version(), **_versions(store)}
    kept = [cell for cell in earlier.cells if cell.key not in cells] if earlier else []
    if earlier and kept and earlier.environment != environment:
        raise DataError(
            path,
            f"{counted(len(kept), 'result')} of it, as {kept[0].key.title}, that {options.store} lacks, "
            f"came from other software ({files.differences(earlier.environment, environment)})",
            "Run them again into the store, or write another file",
        )
    content = files.Baseline(
        format=files.FORMAT,
        changes=[*(earlier.changes if earlier else []), change],
        environment=environment,
        cells=files.sorted_cells([*kept, *(files.cell_of(cell) for cell in cells.values())]),
    )
    files.write(path, content)
    busy = sum(cell.busy for cell in cells.values())
    print(
        f"{path}: {counted(len(content.cells), 'result')}, {path.stat().st_size / 2**10:.0f} KiB"
        + (f"; {len(kept)} as before, which {options.store} lacks" if kept else "")
        + (f"; without {counted(busy, 'time')} of a disturbed clock" if busy else "")
    )
    return 0


def gate_arguments(parser: ArgumentParser) -> None:
    """What ``bench gate`` takes."""
    parser.add_argument("store", nargs="?", default="runs", metavar="STORE", help="default: runs")
    parser.add_argument("--baseline", required=True, metavar="FILE", help="that `bench baseline` wrote")
    parser.add_argument(
        "--without-times", action="store_true", help="ask for no times: quality and sizes alone"
    )
    parser.add_argument(
        "--power",
        action="store_true",
        help="print the smallest losses that the baseline shows, without a run",
    )
    parser.add_argument("--markdown", metavar="FILE", help="write a summary for a comment on a change")
    parser.add_argument(
        "--format", choices=("github-benchmark", "bmf"),
        help="print the run's values as JSON for a service that charts them over commits, and the verdict to "
        "standard error: benchmark-action's list of smaller-is-better values, or Bencher's metric format",
    )  # fmt: skip
    parser.add_argument("--junit", metavar="FILE", help="write the summary as JUnit's XML")


def gate(options: Namespace) -> int:
    """Compare a store with a baseline; the exit code says pass, worse, not measured or error."""
    from econgs_bench.bench.gate import text
    from econgs_bench.bench.gate.baseline import read
    from econgs_bench.bench.gate.charted import charted
    from econgs_bench.bench.gate.judgement import judged
    from econgs_bench.bench.gate.power import markdown

    try:
        if options.power:
            print(markdown(read(Path(options.baseline)), times=not options.without_times))
            return 0
        verdict, content, cells = judged(
            Path(options.baseline), Path(options.store), times=not options.without_times
        )
    except DataError as error:
        print(f"bench: {error}", file=sys.stderr)
        return ERROR
    for line in text.lines(verdict):
        print(line, file=sys.stderr if options.format else sys.stdout)
    if options.format:
        print(charted(cells, options.format))
    try:
        if options.markdown:
            write_text(Path(options.markdown), text.markdown(verdict, content))
        if options.junit:
            text.write_junit(Path(options.junit), verdict)
    except OSError as error:
        what = f"{error.filename or 'its files'}: cannot be written ({error.strerror or error})"
        print(f"bench: {what}. Check its folder and the disk", file=sys.stderr)
        return ERROR
    return verdict.code


def _versions(store: Store) -> dict[str, str]:
    """Software of the store's jobs that decides results."""
    for record in store.records():
        if record.provenance is not None and record.ok and record.job.kind == "fit":
            return dict(sorted(record.provenance.versions.items()))
    return {}
