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
import string
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from econgs_bench.reports.progress import watched
from econgs_bench.reports.schema import TABLES
from econgs_bench.reports.terminal import Terminal, terminal
from econgs_bench.reports.text import one_line

COMMANDS = {
    "run": "econgs_bench.bench.commands.run:run",
    "plan": "econgs_bench.bench.commands.run:plan",
    "tune": "econgs_bench.bench.commands.tune:tune",
    "list": "econgs_bench.bench.commands.lists:list_names",
    "fetch": "econgs_bench.bench.commands.fetch:fetch",
    "doctor": "econgs_bench.bench.commands.doctor:doctor",
    "results": "econgs_bench.bench.commands.results:results",
    "report": "econgs_bench.bench.commands.results:report",
    "scenes": "econgs_bench.bench.commands.scenes:scenes",
    "render": "econgs_bench.bench.commands.pictures:render",
    "export": "econgs_bench.bench.commands.export:export",
    "score": "econgs_bench.bench.commands.pictures:score",
    "samples": "econgs_bench.bench.commands.samples:samples",
    "merge": "econgs_bench.bench.commands.stores:merge",
    "compare": "econgs_bench.bench.commands.stores:compare",
    "cache": "econgs_bench.bench.commands.stores:cache",
    "bundle": "econgs_bench.bench.commands.stores:bundle",
    "verify": "econgs_bench.bench.commands.stores:verify",
    "repair": "econgs_bench.bench.commands.stores:repair",
    "baseline": "econgs_bench.bench.commands.gate:baseline",
    "gate": "econgs_bench.bench.commands.gate:gate",
    "check-plugin": "econgs_bench.bench.commands.check_plugin:check_plugin",
    "new-method": "econgs_bench.bench.commands.new_method:new_method",
}


RETRIES = ("failed", "busy")
"""Finished jobs that run again."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    with terminal() as streams:
        code = _run(arguments, streams)
    return streams.code(code)


def _run(arguments: Sequence[str] | None, streams: Terminal) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        parser().print_help()
        return 2
    options = parser().parse_args(_with_values(arguments))
    from econgs_bench.datasets.errors import DataError

    module, _, function = COMMANDS[options.command].partition(":")
    try:
        with watched(streams, options.command):
            return int(getattr(importlib.import_module(module), function)(options))
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


def parser() -> _Parser:
    """The command line."""
    parser = _Parser(
        prog="bench",
        description="Benchmark of compressed scene representations of volume visualisation.",
        epilog="Exit codes: 0 done, 1 a job failed or is unfinished, 2 unusable input, 130 stopped (Ctrl-C), "
        "141 done, but the output could not be written.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    common = _Parser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show tracebacks of errors in the input")
    plugins = _Parser(add_help=False)
    _repeatable(plugins, "--plugins", metavar="DIR", help="folder with methods of your own")
    stored = _Parser(add_help=False)
    what = "folder with methods of your own; default: those that were given for this run store before"
    _repeatable(stored, "--plugins", metavar="DIR", help=what)
    runs = _Parser(add_help=False)
    runs.add_argument("--runs", default="runs", metavar="DIR", help="the run store (default: runs)")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    parser.commands = commands.choices

    def command(name: str, help: str, *parents: _Parser) -> _Parser:
        return commands.add_parser(name, help=help, description=help, parents=[common, *parents])

    run = command("run", "run a suite and report; what is finished is not run again", stored)
    _add_selection(run)
    _add_execution(run)
    run.add_argument("--no-report", action="store_true", help="leave the page to a later `bench report`")
    plan = command("plan", "show the jobs of a suite, which are done, and an estimate", stored)
    _add_selection(plan)
    _repeatable(plan, "--like", metavar="STORE", help="estimate from the finished jobs of this run store too")

    tune = command("tune", "search for the options with which a method does best on validation views", stored)
    tune.add_argument("method", metavar="METHOD", help="whose options are varied")
    tune.add_argument(
        "suite", nargs="?", default="quick",
        help="whose data, seeds and preset: a suite, or a TOML file (default: quick)",
    )  # fmt: skip
    tune.add_argument("--trials", type=_count, default=24, metavar="N", help="in all (default: 24)")
    tune.add_argument(
        "--objective", default="front", metavar="SCORE",
        help="front[=DB,MIB]: area under PSNR over log2 of size, above DB and below MIB; point=DB,MIB: "
        "the same of the method's own rate alone; size=MIB: PSNR of a model of at most that size; psnr "
        "(default: front=20,64)",
    )  # fmt: skip
    _repeatable(tune, "--option", metavar="NAME", help="vary this, instead of those that the method names")
    _add_data(tune)
    _add_settings(tune, "the same in all trials")
    _add_execution(tune)
    tune.add_argument(
        "--show", action="store_true", help="show the method's studies in the run store, and run nothing"
    )

    lists = command("list", "list methods, datasets, suites or metrics", plugins)
    lists.add_argument("what", choices=("methods", "datasets", "suites", "metrics"))
    fetch = command("fetch", "download public volumes of the catalogue, or the weights of LPIPS")
    fetch.add_argument("names", nargs="+", metavar="NAME", help="a dataset, a TOML file of yours, or lpips")
    fetch.add_argument("--out", metavar="DIR", help="default: the user's data folder, which is searched")
    check = command("check-plugin", "check that a method keeps what its contract promises", plugins)
    check.add_argument("method", metavar="METHOD")
    check.add_argument(
        "--iterations", type=_count, default=60, metavar="N", help="of each of its fits (default: 60)"
    )
    _repeatable(check, "--set", metavar="OPTION=VALUE", help="differing from the preset quick")
    _add_device(check)
    new = command("new-method", "write the files of a new method: one that trains, to begin with")
    new.add_argument("name", metavar="NAME", help="its name: lower-case letters, digits, -")
    new.add_argument(
        "--out", default=".", metavar="DIR", help="where its folder goes (default: the present folder)"
    )
    command("doctor", "what this machine has and lacks, with remedies, and how busy it is", plugins)

    results = command("results", "every measurement of a run store", stored, runs)
    results.add_argument("--table", choices=TABLES, default="results", help="default: results")
    results.add_argument(
        "--format", choices=("csv", "md", "tex", "json"),
        help="all columns; default: a table of those that fit into the terminal, with the jobs",
    )  # fmt: skip
    purpose = "print the paper's tables as measured, and write the HTML report of a run store"
    report = command("report", purpose, stored, runs)
    report.add_argument(
        "--out",
        metavar="DIR",
        help="folder for report.html and what goes with it, or the page's name (default: the run store)",
    )
    report.add_argument(
        "--check-claims",
        action="store_true",
        help="list the paper's claims: hold, do not, not decided, not measured",
    )

    scenes = command(
        "scenes", "propose transfer functions for a volume file, to edit, and draw what they show"
    )
    scenes.add_argument("file", metavar="FILE", help="a volume file, or the TOML file of an earlier call")
    scenes.add_argument(
        "--out", metavar="NAME.toml", help="file to write, which is never overwritten (default: here)"
    )
    scenes.add_argument(
        "--range", metavar="LOW,HIGH", help='values to show, or "all" (default: all but outliers)'
    )
    scenes.add_argument("--missing", metavar="V,V...", help="values that stand for missing data")
    scenes.add_argument("--views", type=_count, help="number of views of each scene (default: 3)")
    scenes.add_argument("--size", type=_size, metavar="WxH", help="pixels of a view (default: 200)")
    render = command("render", "write pictures: ground truth, or those of a finished model", stored, runs)
    render.add_argument(
        "dataset", nargs="*",
        help="name in the catalogue, or a path; contact sheets: default all that are here",
    )  # fmt: skip
    _repeatable(render, "--scene", help="only this scene")
    render.add_argument(
        "--views", type=_count, help="number of views on the test path (default: 8; contact sheets: 3)"
    )
    render.add_argument(
        "--size",
        type=_size,
        metavar="WxH",
        help="pixels (default: 256, of pre-rendered views their own; contact sheets: 140)",
    )
    render.add_argument(
        "--contact-sheet", action="store_true",
        help="one picture per dataset: small views of all scenes, with transfer functions over histograms",
    )  # fmt: skip
    render.add_argument(
        "--automatic", action="store_true", help="contact sheets: the automatic transfer functions too"
    )
    render.add_argument("--out", default="pictures", metavar="DIR", help="default: pictures")
    render.add_argument("--model", metavar="JOB", help="an encode or measure job of --runs: render its model")
    _repeatable(
        render, "--edit", metavar="SCENE.WHAT=VALUE",
        help="show it edited: palette=#ff8800, light=headlight or x,y,z, or a factor: opacity, ambient, "
        "diffuse, specular, shininess",
    )  # fmt: skip
    render.add_argument(
        "--truth", action="store_true", help="with --model: the ground truth beside, and PSNR"
    )
    _add_samples(render)
    _add_device(render)
    export = command(
        "export", "write a finished model of Gaussians as a file that viewers of splats open", stored, runs
    )
    export.add_argument("model", metavar="JOB", help="an encode or measure job of --runs")
    export.add_argument("--out", required=True, metavar="FILE", help="the file to write")
    export.add_argument(
        "--format", choices=("ply", "spz", "sog", "glb"), help="default: as the suffix of --out says"
    )
    export.add_argument("--scene", help="which, if the model holds several")
    export.add_argument(
        "--distil", type=_iterations, default=1_000, metavar="N",
        help="iterations against the model's own pictures, where it has to be baked; 0: none (default: 1000)",
    )  # fmt: skip
    _add_device(export)
    samples = command(
        "samples", "what rays a pixel are worth: a scene with 1, 4, 16 ... rays against finer truth"
    )
    samples.add_argument("dataset", help="name in the catalogue, or a path")
    _repeatable(samples, "--scene", help="only this scene")
    samples.add_argument("--views", type=_count, help="number of test views (default: 4)")
    samples.add_argument("--size", type=_size, metavar="WxH", help="pixels (default: 128)")
    samples.add_argument("--format", choices=("csv", "md", "tex", "json"), default="md")
    score = command("score", "apply the metrics to two folders of images")
    score.add_argument("renders", metavar="RENDERS")
    score.add_argument("truth", metavar="TRUTH")
    score.add_argument("--format", choices=("csv", "md", "tex", "json"), default="csv")

    merge = command("merge", "join run stores and bundles, of several machines", stored)
    merge.add_argument("stores", nargs="+", metavar="STORE|BUNDLE")
    merge.add_argument("--out", required=True, metavar="DIR", help="a new run store, or one to add to")
    compare = command("compare", "pair two run stores view by view")
    compare.add_argument("stores", nargs=2, metavar="RUN")
    compare.add_argument("--format", choices=("csv", "md", "tex", "json"), help="default: a table for people")
    baseline = command("baseline", "write a run store's results as a baseline for `bench gate`")
    baseline.add_argument("store", nargs="?", default="runs", metavar="STORE", help="default: runs")
    baseline.add_argument("--out", required=True, metavar="FILE", help="the baseline, new or to update")
    baseline.add_argument("--reason", required=True, help="why its results are what is expected from now on")
    gate = command("gate", "compare a run store with a baseline: 0 pass, 1 worse, 2 not measured, 3 error")
    gate.add_argument("store", nargs="?", default="runs", metavar="STORE", help="default: runs")
    gate.add_argument("--baseline", required=True, metavar="FILE", help="that `bench baseline` wrote")
    gate.add_argument(
        "--without-times", action="store_true", help="ask for no times: quality and sizes alone"
    )
    gate.add_argument(
        "--power",
        action="store_true",
        help="print the smallest losses that the baseline shows, without a run",
    )
    gate.add_argument("--markdown", metavar="FILE", help="write a summary for a comment on a change")
    gate.add_argument("--junit", metavar="FILE", help="write the summary as JUnit's XML")
    bundle = command("bundle", "pack a run store's records, tables and environments to hand in", runs)
    bundle.add_argument("--out", required=True, metavar="FILE", help="the zip file")
    bundle.add_argument("--models", action="store_true", help="with the encoded models")
    verify = command("verify", "check that a bundle contradicts itself nowhere: 0 it holds, 1 not", plugins)
    verify.add_argument("bundle", metavar="FILE")
    verify.add_argument(
        "--redo", type=_count, default=0, metavar="N",
        help="decode N models and measure them in views that the bundle's hash chooses; 2: not possible here",
    )  # fmt: skip
    _repeatable(verify, "--dataset", metavar="PATH", help="data that the catalogue lacks, for --redo")
    _add_limits(verify)
    command("repair", "set damaged records of a run store aside, so that their jobs run again", runs)
    cache = command("cache", "ground-truth cache: what it takes, or make it smaller")
    cache.add_argument("action", choices=("info", "prune"))
    cache.add_argument(
        "--max-size", type=_bytes, metavar="SIZE", help="prune to this size (default: its cap)"
    )
    return parser


def _add_selection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", help="a suite of `bench list suites`, or a TOML file")
    _add_data(parser)
    parser.add_argument("--composed", action="store_true", help="measure the compositions of the scenes too")
    _repeatable(parser, "--method", help="instead of the suite's")
    parser.add_argument(
        "--split", choices=("test", "val"), default="test",
        help="measure on test views, or leave every tenth training view out of the fit and measure on those",
    )  # fmt: skip
    _add_samples(parser)
    _add_settings(parser, "differing from the preset")


def _add_samples(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--samples", metavar="N|auto",
        help="rays a pixel of rendered views: 1, 4, 9 ...; default: the dataset's, else as many as it needs",
    )  # fmt: skip


def _add_data(parser: argparse.ArgumentParser) -> None:
    _repeatable(
        parser, "--dataset", metavar="NAME|PATH",
        help="only this of the suite's, or data of your own instead",
    )  # fmt: skip
    _repeatable(parser, "--scene", help="only this scene, or composition with its scenes")


def _add_settings(parser: argparse.ArgumentParser, overrides: str) -> None:
    _repeatable(parser, "--seed", type=_seed, help="instead of the suite's")
    parser.add_argument(
        "--preset", choices=("quick", "standard", "paper"),
        help="resolution, number of views and length of training (default: the suite's)",
    )  # fmt: skip
    _repeatable(parser, "--set", metavar="METHOD.OPTION=VALUE", help=overrides)
    _add_device(parser)
    parser.add_argument("--out", default="runs", metavar="DIR", help="the run store (default: runs)")


def _add_execution(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--retry", nargs="?", const=RETRIES[0], choices=RETRIES, metavar="failed|busy",
        help="run failed jobs again (without a value), or those whose time was disturbed (busy): a model is "
        "measured again for its FPS, fitted and measured again for its training time; results stay until new "
        "ones are finished",
    )  # fmt: skip
    _add_limits(parser)
    parser.add_argument(
        "--executor", choices=("local", "dask"), default="local",
        help="one job after the other on this machine, or jobs beside each other on workers of Dask "
        "(default: local)",
    )  # fmt: skip
    parser.add_argument(
        "--scheduler", default="", metavar="ADDRESS",
        help="with --executor dask: the scheduler, or its file; default: one on this machine",
    )  # fmt: skip
    parser.add_argument(
        "--workers", type=_count, metavar="N",
        help="with --executor dask on this machine: how many share its cores (default: 1)",
    )  # fmt: skip


def _repeatable(parser: argparse.ArgumentParser, name: str, *, help: str, **more: Any) -> None:
    parser.add_argument(name, action="append", default=[], help=f"{help} (repeatable)", **more)


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device", type=_device, default="cpu", help="cpu, cuda or cuda:<number> (default: cpu)"
    )


def _iterations(text: str) -> int:
    return 0 if text == "0" else _count(text)


def _device(text: str) -> str:
    kind, _, number = text.partition(":")
    if text != "cpu" and not (kind == "cuda" and (text == "cuda" or number.isdecimal())):
        raise argparse.ArgumentTypeError(f"{text!r} is not cpu, cuda or cuda:<number>")
    return text


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def _seconds(text: str) -> float:
    return _positive(text, {"": 1.0, "S": 1.0, "M": 60.0, "H": 3600.0}, "a time such as 90, 30m or 2h")


def _add_limits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--time-limit", type=_time_limit, metavar="TIME",
        help="per job: 90, 90s, 30m, 2h or none; default: 60 times what jobs like it took here, half an hour "
        "at least; of the first ones 8 hours (quick), 2 days (standard) or 8 days (paper)",
    )  # fmt: skip
    parser.add_argument(
        "--memory-limit", type=_memory_limit, metavar="SIZE",
        help="per job: 8G, 500M, or none; default: 95 %% of the machine's memory",
    )  # fmt: skip


def _time_limit(text: str) -> float:
    return float("inf") if text == "none" else _seconds(text)


def _memory_limit(text: str) -> float:
    return float("inf") if text == "none" else _bytes(text)


def _bytes(text: str) -> int:
    units = {"": 1.0, "K": 2.0**10, "M": 2.0**20, "G": 2.0**30, "T": 2.0**40}
    units.update({f"{unit}{byte}": units[unit] for unit in "KMGT" for byte in ("B", "IB")})
    return int(_positive(text, units, "a size such as 500M or 8G"))


def _positive(text: str, units: dict[str, float], example: str) -> float:
    number = text.rstrip(string.ascii_letters)
    unit = units.get(text[len(number) :].upper())
    try:
        value = float(number) * unit if unit else -1.0
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not {example}")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 1")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    return _count(width), _count(height or width)


if __name__ == "__main__":
    sys.exit(main())
