"""The command line: ``bench`` or ``python -m econgs_bench.bench``.

Each command imports only what it needs: ``bench list`` starts without torch.

Exit codes: 0 all done; 1 some job failed or was not finished (its row says why); 2 the request or its
input cannot be used; 130 stopped by Ctrl-C (run again to resume); 141 all done, but not all of its output
could be written (a closed pipe, a full disk).
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from econgs_bench.bench.commands.arguments import RETRIES
from econgs_bench.reports.progress import watched
from econgs_bench.reports.terminal import Terminal, terminal
from econgs_bench.reports.text import one_line

COMMANDS = {
    "run": ("run:run", "run a suite and report; what is finished is not run again"),
    "plan": ("run:plan", "show the jobs of a suite, which are done, and an estimate"),
    "tune": ("tune:tune", "search for the options with which a method does best on validation views"),
    "list": ("lists:list_names", "list methods, datasets, suites or metrics"),
    "fetch": ("fetch:fetch", "download public volumes of the catalogue, or the weights of LPIPS"),
    "check-plugin": ("check_plugin:check_plugin", "check that a method keeps what its contract promises"),
    "new-method": (
        "new_method:new_method",
        "write the files of a new method: one that trains, to begin with",
    ),
    "doctor": ("doctor:doctor", "what this machine has and lacks, with remedies, and how busy it is"),
    "results": ("results:results", "every measurement of a run store"),
    "report": (
        "results:report",
        "print the paper's tables as measured, and write the HTML report of a run store",
    ),
    "scenes": (
        "scenes:scenes",
        "propose transfer functions for a volume file, to edit, and draw what they show",
    ),
    "render": ("pictures:render", "write pictures: ground truth, or those of a finished model"),
    "view": ("view:view", "look at models and scenes in a browser: turn, edit, compare, beside the truth"),
    "export": ("export:export", "write a finished model of Gaussians as a file that viewers of splats open"),
    "export-views": (
        "export_views:export_views",
        "write training views and test cameras as folders that other trainers load",
    ),
    "samples": (
        "samples:samples",
        "what rays a pixel are worth: a scene with 1, 4, 16 ... rays against finer truth",
    ),
    "score": ("pictures:score", "apply the metrics to two folders of images"),
    "merge": ("stores:merge", "join run stores and bundles, of several machines"),
    "compare": ("stores:compare", "pair two run stores view by view"),
    "baseline": ("gate:baseline", "write a run store's results as a baseline for `bench gate`"),
    "gate": ("gate:gate", "compare a run store with a baseline: 0 pass, 1 worse, 2 not measured, 3 error"),
    "bundle": ("stores:bundle", "pack a run store's records, tables and environments to hand in"),
    "verify": ("stores:verify", "check that a bundle contradicts itself nowhere: 0 it holds, 1 not"),
    "site": ("site:site", "write a static site of bundles: answers, datasets, methods, submissions"),
    "repair": ("stores:repair", "set damaged records of a run store aside, so that their jobs run again"),
    "cache": ("stores:cache", "ground-truth cache: what it takes, or make it smaller"),
}
"""Command -> module of :mod:`.bench.commands` and function, and help in one line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    with terminal() as streams:
        code = _run(arguments, streams)
    return streams.code(code)


def _run(arguments: Sequence[str] | None, streams: Terminal) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        parser("none").print_help()
        return 2
    known = next((word for word in arguments if word in COMMANDS), "none")
    options = parser(known).parse_args(_with_values(arguments))
    from econgs_bench.datasets.errors import DataError

    try:
        with watched(streams, options.command):
            return int(_of(options.command)(options))
    except DataError as error:
        if options.debug:
            raise
        print(f"bench: {one_line(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: stopped", file=sys.stderr)
        return 130
    except OSError as error:
        if options.debug:
            raise
        what = error.filename or type(error).__name__
        remedy = "Check that it exists, that you may use it and that the disk has room"
        print(f"bench: {one_line(f'{what}: {error.strerror or error}')}. {remedy}", file=sys.stderr)
        return 2


def _with_values(arguments: Sequence[str]) -> list[str]:
    """Arguments in which a bare ``--retry`` has its value: else it would take the word after it for one."""
    words = list(arguments)
    for place, word in enumerate(words):
        if word == "--retry" and words[place + 1 : place + 2] not in ([value] for value in RETRIES):
            words[place] = f"--retry={RETRIES[0]}"
    return words


class _Parser(argparse.ArgumentParser):
    commands: Mapping[str, argparse.ArgumentParser] = {}
    """Says what is wrong with a command line in one line, with options near an unknown one."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, rest = self.parse_known_args(args, namespace)
        if rest:
            import difflib

            usage = self.commands[options.command].format_usage()
            known = sorted({*re.findall(r"--[a-z-]+", usage), "--help"})
            words = [word.partition("=")[0] for word in rest if word.startswith("-")]
            near = [one for word in words for one in difflib.get_close_matches(word, known, n=1)]
            hint = f". Did you mean {', '.join(near)}?" if near else ""
            self.error(f"unrecognized arguments: {' '.join(rest)}{hint}", options.command)
        return options

    def error(self, message: str, command: str = "") -> NoReturn:
        end = "" if message.endswith("?") else "."
        self.exit(2, f"bench: {one_line(message)}{end} See `{f'{self.prog} {command}'.strip()} --help`\n")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"econgs-bench {version('econgs-bench')}")
        parser.exit()


def parser(command: str = "") -> _Parser:
    """The command line; of one command alone, as others need not be imported for it.

    Args:
        command: whose arguments are read; "" for all.
    """
    parser = _Parser(
        prog="bench",
        description="Benchmark of compressed scene representations of volume visualisation.",
        epilog="Exit codes: 0 done, 1 a job failed or is unfinished, 2 unusable input, 130 stopped (Ctrl-C), "
        "141 done, but the output could not be written.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    parser.commands = commands.choices
    for name, (_, help) in COMMANDS.items():
        own = commands.add_parser(name, help=help, description=help)
        own.add_argument("--debug", action="store_true", help="show tracebacks of errors in the input")
        if command in ("", name):
            _of(name, "_arguments")(own)
    return parser


def _of(command: str, what: str = "") -> Any:
    """The function of a command, or that which adds its arguments."""
    module, _, function = COMMANDS[command][0].partition(":")
    return getattr(importlib.import_module(f"econgs_bench.bench.commands.{module}"), function + what)


if __name__ == "__main__":
    sys.exit(main())
