"""``bench fetch``: public volumes of the catalogue, and the network weights of LPIPS."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from econgs_bench.bench.commands.lists import size_text
from econgs_bench.bench.metrics.lpips import BACKBONES, checkpoints, is_sound
from econgs_bench.datasets.catalogue import entries
from econgs_bench.datasets.download import UNKNOWN_SIZE, Remote
from econgs_bench.datasets.download import fetch as download
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown

LPIPS = "lpips"


@dataclass(frozen=True)
class Request:
    """What one name of the command line stands for.

    Attributes:
        files: target -> what is to be downloaded there.
        acknowledgement: whose the files are.
        state: why nothing is to be downloaded; "" where something is.
        source: where to get what cannot be downloaded; "" where nothing is of that kind.
    """

    name: str
    files: dict[Path, Remote] = field(default_factory=dict)
    acknowledgement: str = ""
    state: str = ""
    source: str = ""


def fetch_arguments(parser: ArgumentParser) -> None:
    """What ``bench fetch`` takes."""
    parser.add_argument("names", nargs="+", metavar="NAME", help="a dataset, a TOML file of yours, or lpips")
    parser.add_argument("--out", metavar="DIR", help="default: the user's data folder, which is searched")


def fetch(options: Namespace) -> int:
    """Download what the names need. All names are checked before the first byte."""
    out = Path(options.out).expanduser() if options.out else None
    code = 0
    for request in [_request(name, out) for name in options.names]:
        if request.state:
            print(f"{request.name}: {request.state}")
        if request.source:
            print(f"bench: {request.name}: cannot be fetched. {request.source}", file=sys.stderr)
            code = max(code, 2)
        if request.files and request.acknowledgement:
            print(f"{request.name}: acknowledgement: {request.acknowledgement}", file=sys.stderr)
        try:
            for target, remote in request.files.items():
                _download(request.name, remote, target)
        except DataError as error:
            if options.debug:
                raise
            print(f"bench: {error}", file=sys.stderr)
            code = max(code, 1)
    if out is not None and not code and out.resolve() not in [f.resolve() for f in entries.data_folders()]:
        print(f"bench: to use it, add {out.resolve()} to {entries.ENVIRONMENT}", file=sys.stderr)
    return code


def _request(name: str, out: Path | None) -> Request:
    if name == LPIPS:
        return _weights(out)
    if name.endswith(".toml"):
        from econgs_bench.datasets.catalogue.own import read_entry

        table = read_entry(Path(name).expanduser())
        folders = [Path(name).expanduser().resolve().parent, *entries.data_folders()]
    else:
        name = name.partition("@")[0]
        if name not in entries.names():
            raise unknown("dataset", name, [*entries.names(), LPIPS])
        table, folders = entries.entry(name), entries.folders_of(name)
    if table["kind"] == "procedural":
        return Request(name, state="procedural: it needs no files")
    places = {
        path: entries.locate(path, folders if out is None else [out]) for path in entries.paths_of(table)
    }
    missing = [path for path, at in places.items() if at is None]
    if not missing:
        return Request(name, state=f"already here: {next(iter(places.values()))}")
    public = entries.public_files(table)
    elsewhere = [path for path in missing if path not in public]
    acknowledgement = table.get("acknowledgement", "")
    listing = ", ".join(elsewhere[:4]) + (f" and {len(elsewhere) - 4} more" if len(elsewhere) > 4 else "")
    source = f"Put {listing} into a folder of {entries.ENVIRONMENT}"
    source += f"; source: {acknowledgement}" if acknowledgement else ""
    files = {}
    for path in missing:
        if path in public:
            url, zipped = public[path]["url"], public[path]["url"].endswith(".gz") and path[-3:] != ".gz"
            plain = entries.size_of(table, path)
            size = None if zipped else plain
            most = UNKNOWN_SIZE if plain is None else plain + plain // 100 + 2**20  # gzip adds less
            target = (out or entries.user_folder()) / (f"{path}.gz" if zipped else path)
            files[target] = Remote(url, "sha512", public[path]["sha512"], size, most)
    return Request(name, files, acknowledgement, source=source if elsewhere else "")


def _weights(out: Path | None) -> Request:
    """The backbones of LPIPS that are missing or damaged where the metric looks."""
    if out is not None:
        raise DataError(LPIPS, "its weights belong where torch looks for them", "Set TORCH_HOME, not --out")
    folder = checkpoints()
    files = {
        folder / backbone.file: Remote(backbone.url, "sha256", backbone.sha256)
        for backbone in BACKBONES.values()
        if not is_sound(backbone, folder)
    }
    terms = "weights of torchvision (BSD 3-Clause), trained on ImageNet, whose terms may apply"
    return Request(LPIPS, files, terms, state="" if files else f"already here: {folder}")


def _download(name: str, remote: Remote, target: Path) -> None:
    size = f"{size_text(remote.size)}, " if remote.size is not None else ""
    print(f"{name}: {target.name}, {size}from {remote.host}", file=sys.stderr)
    present = 0
    try:
        with _bar(name) as bar:

            def progress(count: int, total: int | None) -> None:
                nonlocal present
                present = count
                bar(count, total)

            download(remote, target, progress)
    except KeyboardInterrupt:
        print(f"bench: {size_text(present)} of {target.name} are kept, to be resumed", file=sys.stderr)
        raise
    print(f"{name}: {target}, {size_text(target.stat().st_size)}, {remote.algorithm.upper()} matches")


@contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int | None], None]]:
    """A progress bar on standard error, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda count, total: None
        return
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from econgs_bench.reports.terminal import console

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=None),
        DownloadColumn(binary_units=True),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console("stderr"), transient=True, expand=True) as bar:

        def update(count: int, total: int | None) -> None:
            if bar.tasks:
                bar.update(bar.tasks[0].id, completed=count, total=total)
            else:  # what an earlier call left takes no part in the time left
                bar.add_task(name, total=total, completed=count)

        yield update
