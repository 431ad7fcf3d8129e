"""Arguments that several commands take, and the types of their values."""

from __future__ import annotations

import string
from argparse import ArgumentParser, ArgumentTypeError
from typing import Any

FORMATS = ("csv", "md", "tex", "json")
RETRIES = ("failed", "busy")
"""Finished jobs that run again."""


def add_plugins(parser: ArgumentParser) -> None:
    """Folders of methods."""
    repeatable(parser, "--plugins", metavar="DIR", help="folder with methods of your own")


def add_stored(parser: ArgumentParser) -> None:
    """Folders of methods, which the run store remembers."""
    what = "folder with methods of your own; default: those that were given for this run store before"
    repeatable(parser, "--plugins", metavar="DIR", help=what)


def add_runs(parser: ArgumentParser) -> None:
    """The run store that is read."""
    parser.add_argument("--runs", default="runs", metavar="DIR", help="the run store (default: runs)")


def add_selection(parser: ArgumentParser) -> None:
    """What is run: suite, data, methods, views, settings."""
    parser.add_argument("suite", help="a suite of `bench list suites`, or a TOML file")
    add_data(parser)
    parser.add_argument("--composed", action="store_true", help="measure the compositions of the scenes too")
    repeatable(parser, "--method", dest="methods", help="instead of the suite's")
    parser.add_argument(
        "--split", choices=("test", "val"), default="test",
        help="measure on test views, or leave every tenth training view out of the fit and measure on those",
    )  # fmt: skip
    add_samples(parser)
    add_settings(parser, "differing from the preset")


def add_samples(parser: ArgumentParser) -> None:
    """Rays a pixel."""
    parser.add_argument(
        "--samples", metavar="N|auto",
        help="rays a pixel of rendered views: 1, 4, 9 ...; default: the dataset's, else as many as it needs",
    )  # fmt: skip


def add_data(parser: ArgumentParser) -> None:
    """Datasets and scenes."""
    repeatable(
        parser, "--dataset", dest="datasets", metavar="NAME|PATH",
        help="only this of the suite's, or data of your own instead",
    )  # fmt: skip
    repeatable(parser, "--scene", dest="scenes", help="only this scene, or composition with its scenes")


def add_settings(parser: ArgumentParser, overrides: str) -> None:
    """Seeds, preset, options, device and run store."""
    repeatable(parser, "--seed", dest="seeds", type=seed, help="instead of the suite's")
    parser.add_argument(
        "--preset", default="", choices=("quick", "standard", "paper"),
        help="resolution, number of views and length of training (default: the suite's)",
    )  # fmt: skip
    repeatable(parser, "--set", metavar="METHOD.OPTION=VALUE", help=overrides)
    add_device(parser)
    parser.add_argument("--out", default="runs", metavar="DIR", help="the run store (default: runs)")


def add_execution(parser: ArgumentParser) -> None:
    """How jobs run."""
    parser.add_argument(
        "--retry", nargs="?", const=RETRIES[0], choices=RETRIES, metavar="failed|busy",
        help="run failed jobs again (without a value), or those whose time was disturbed (busy): a model is "
        "measured again for its FPS, fitted and measured again for its training time; results stay until new "
        "ones are finished",
    )  # fmt: skip
    add_limits(parser)
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
        "--workers", type=count, metavar="N",
        help="with --executor dask on this machine: how many share its cores (default: 1)",
    )  # fmt: skip


def repeatable(parser: ArgumentParser, name: str, *, help: str, **more: Any) -> None:
    """An option that may be given several times."""
    parser.add_argument(name, action="append", default=[], help=f"{help} (repeatable)", **more)


def add_device(parser: ArgumentParser) -> None:
    """The device of a method."""
    parser.add_argument(
        "--device", type=device, default="cpu", help="cpu, cuda or cuda:<number> (default: cpu)"
    )


def iterations(text: str) -> int:
    """A number of iterations, from 0."""
    return 0 if text == "0" else count(text)


def device(text: str) -> str:
    """One of "cpu", "cuda" and "cuda:N"."""
    kind, _, number = text.partition(":")
    if text != "cpu" and not (kind == "cuda" and (text == "cuda" or number.isdecimal())):
        raise ArgumentTypeError(f"{text!r} is not cpu, cuda or cuda:<number>")
    return text


def seed(text: str) -> int:
    """A whole number from 0."""
    if not text.isdecimal():
        raise ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def seconds(text: str) -> float:
    """A time such as 90, 30m or 2h, in seconds."""
    return _positive(text, {"": 1.0, "S": 1.0, "M": 60.0, "H": 3600.0}, "a time such as 90, 30m or 2h")


def add_limits(parser: ArgumentParser) -> None:
    """Time and memory of a job."""
    parser.add_argument(
        "--time-limit", type=time_limit, metavar="TIME",
        help="per job: 90, 90s, 30m, 2h or none; default: 60 times what jobs like it took here, half an hour "
        "at least; of the first ones 8 hours (quick), 2 days (standard) or 8 days (paper)",
    )  # fmt: skip
    parser.add_argument(
        "--memory-limit", type=memory_limit, metavar="SIZE",
        help="per job: 8G, 500M, or none; default: 95 %% of the machine's memory",
    )  # fmt: skip


def time_limit(text: str) -> float:
    """Seconds, or infinity for "none"."""
    return float("inf") if text == "none" else seconds(text)


def memory_limit(text: str) -> float:
    """Bytes, or infinity for "none"."""
    return float("inf") if text == "none" else byte_size(text)


def byte_size(text: str) -> int:
    """A size such as 500M or 8G, in bytes."""
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
        raise ArgumentTypeError(f"{text!r} is not {example}")
    return value


def count(text: str) -> int:
    """A whole number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"{text!r} is not a number of at least 1")
    return int(text)


def size(text: str) -> tuple[int, int]:
    """Width and height of "WxH", or of one number for both."""
    width, _, height = text.lower().partition("x")
    return count(width), count(height or width)
