"""``bench view``: models and scenes in a browser, as the harness draws them."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from econgs_bench.bench.commands.arguments import add_device, add_runs, add_stored
from econgs_bench.reports.progress import hushed, step


def view_arguments(parser: ArgumentParser) -> None:
    """What ``bench view`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument(
        "what", nargs="*", metavar="WHAT",
        help="jobs of --runs, folders of run stores or models, exported files (ply, spz, sog), datasets or "
        "their files; default: every model of --runs",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=0, help="of the page on this machine (default: a free one)"
    )
    parser.add_argument("--no-open", action="store_true", help="print the address alone, open no browser")
    add_device(parser)


def view(options: Namespace) -> int:
    """Serve the page until Ctrl-C."""
    import webbrowser

    from econgs_bench.bench.view.server import Server, Viewer
    from econgs_bench.bench.view.sources import found

    step("loading what is looked at")
    sources = found(options.what, Path(options.runs), options.plugins, options.device)
    with Server(Viewer(sources), options.port) as server, hushed():
        print(f"{server.address}\nCtrl-C ends it", flush=True)
        if not options.no_open:
            webbrowser.open(server.address)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print()
    return 0
