"""``bench check-plugin``: does a method keep what the contract promises?"""

from __future__ import annotations

import sys
import tempfile
from argparse import Namespace
from pathlib import Path


def check_plugin(options: Namespace) -> int:
    """Run the contract kit on a method; returns 1 if a promise is broken."""
    from methods.interface import Refused
    from methods.options import parse_assignments
    from methods.registry import Registry, load_method

    folders = [Path(folder) for folder in options.plugins]
    spec = Registry(folders).spec(options.method)
    overrides = parse_assignments(f"{spec.name}.{text}" for text in options.set).get(spec.name, {})
    method = load_method(spec)

    from bench.worker import prepare_device
    from methods.contract.checks import Subject, run_checks

    try:
        prepare_device(options.device, spec)
    except Refused as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    broken = 0
    with tempfile.TemporaryDirectory(prefix="bench-check-") as temporary:
        subject = Subject(
            spec, method, Path(temporary), options.iterations, overrides, folders, options.device
        )
        for outcome in run_checks(subject):
            name = outcome.name.replace("_", " ")
            print(f"{outcome.status:<7} {name:<17} {outcome.seconds:6.1f} s  {outcome.detail}", flush=True)
            broken += outcome.status != "passed"
    if broken:
        print(f"bench: {spec.name} breaks {broken} of its promises", file=sys.stderr)
    return 1 if broken else 0
