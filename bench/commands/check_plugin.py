"""``bench check-plugin``: does a method keep what the contract promises?"""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser, Namespace
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING

from econgs_bench.bench.commands.arguments import add_device, add_plugins, count, repeatable

if TYPE_CHECKING:
    from econgs_bench.methods.contract.checks import Outcome

FAULTS = {
    "plugin": "the plugin's code",
    "harness": "the harness: please report it, with the output of --debug",
    "machine": "the machine: memory, disk or open files ran out, or the process was killed",
}


def check_plugin_arguments(parser: ArgumentParser) -> None:
    """What ``bench check-plugin`` takes."""
    add_plugins(parser)
    parser.add_argument("method", metavar="METHOD")
    parser.add_argument(
        "--iterations", type=count, default=60, metavar="N", help="of each of its fits (default: 60)"
    )
    repeatable(parser, "--set", metavar="OPTION=VALUE", help="differing from the preset quick")
    add_device(parser)


def check_plugin(options: Namespace) -> int:
    """Run the contract kit on a method; returns 1 if a promise is broken."""
    from econgs_bench.methods.interface import Refused
    from econgs_bench.methods.options import parse_assignments
    from econgs_bench.methods.registry import Registry, load_method

    folders = [Path(folder) for folder in options.plugins]
    spec = Registry(folders).spec(options.method)
    overrides = parse_assignments(f"{spec.name}.{text}" for text in options.set).get(spec.name, {})
    method = load_method(spec)

    from econgs_bench.bench.machine.device import prepare_device
    from econgs_bench.methods.contract.checks import Subject, run_checks

    try:
        prepare_device(options.device, spec)
    except Refused as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    broken = 0
    known: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="bench-check-") as temporary:
        subject = Subject(
            spec, method, Path(temporary), options.iterations, overrides, folders, options.device
        )
        for outcome in run_checks(subject):
            name = outcome.name.replace("_", " ")
            print(f"{outcome.status:<7} {name:<17} {outcome.seconds:6.1f} s  {outcome.detail}", flush=True)
            if outcome.status != "passed":
                broken += 1
                _explain(outcome, known)
                if options.debug:
                    print(outcome.traceback, file=sys.stderr)
    if broken:
        print(f"bench: {spec.name} breaks {broken} of its promises", file=sys.stderr)
    return 1 if broken else 0


def _explain(outcome: Outcome, known: set[str]) -> None:
    """Print the promise, whose fault it is, and the lines of the plugin that led there, unless known."""
    assert outcome.failure is not None
    trace = outcome.failure.trace
    lines = [f"promise: {outcome.promise}", f"at fault: {FAULTS[outcome.failure.fault]}"]
    lines += ["at the same lines as above"] if trace in known else trace.splitlines()
    print(indent("\n".join(lines), " " * 8), flush=True)
    if trace:
        known.add(trace)
