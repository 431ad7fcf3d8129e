"""Suites: named sets of datasets, methods, option variants, seeds and presets, as TOML files."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from datasets.errors import DataError
from datasets.names import unknown

FOLDER = Path(__file__).parent / "suites"
PRESETS = ("quick", "standard", "paper")


@dataclass(frozen=True)
class ViewPreset:
    """Views of a preset.

    Attributes:
        train_views, test_views: see :class:`datasets.views.ViewRequest`.
        width, height: pixels of rendered views.
        prerendered_limit: pre-rendered views keep their own size up to this many pixels along the
            longer side; larger ones are area-averaged by the smallest whole factor that fits.
        cloud_points: size of the initial cloud.
    """

    train_views: int
    test_views: int
    width: int
    height: int
    prerendered_limit: int
    cloud_points: int = 10_000


@dataclass(frozen=True)
class Suite:
    """What a suite file says.

    Attributes:
        datasets: dataset name -> scenes, or compositions with their scenes (empty: all scenes).
        methods: names; those in ``optional`` are left out where they are not registered.
        compositions: which compositions of the chosen scenes are measured: names, "all", or none.
        dvr: time direct volume rendering of each scene, and its memory.
        variants: sets of options, method -> option -> value; {} is the presets' own.
        rates: "default" (each method's own size) or "all" (the rate knobs' values).
    """

    name: str
    title: str
    datasets: Mapping[str, tuple[str, ...]]
    methods: tuple[str, ...]
    optional: tuple[str, ...]
    seeds: tuple[int, ...]
    preset: str
    presets: Mapping[str, ViewPreset]
    variants: tuple[Mapping[str, Mapping[str, Any]], ...] = field(default=({},))
    rates: str = "default"
    compositions: Literal["all"] | tuple[str, ...] = ()
    dvr: bool = False


def names() -> list[str]:
    """Names of the suites that come with the program."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_suite(name: str) -> Suite:
    """A suite by name, or by the path of a TOML file.

    Raises:
        UnknownName: no suite has that name.
        DataError: the file is no suite.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        if name.endswith(".toml"):
            raise DataError(path, "no such file", "Name a suite of `bench list suites`, or a TOML file")
        raise unknown("suite", name, names())
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise DataError(path, f"not valid TOML ({error})", "Correct the file") from error
    return _parse(path, data)


def _parse(path: Path, data: dict[str, Any]) -> Suite:
    known = {
        "title", "datasets", "methods", "optional", "seeds", "preset", "presets", "variants", "rates",
        "compositions", "dvr",
    }  # fmt: skip
    for key in data:
        if key not in known:
            raise unknown("key", key, known, of=str(path))
    compositions = data.get("compositions", [])
    try:
        presets = {name: ViewPreset(**table) for name, table in data["presets"].items()}
        suite = Suite(
            name=path.stem,
            title=str(data["title"]),
            datasets={str(name): tuple(scenes) for name, scenes in data["datasets"].items()},
            methods=tuple(data.get("methods", ())),
            optional=tuple(data.get("optional", ())),
            seeds=tuple(int(seed) for seed in data.get("seeds", [0])),
            preset=str(data["preset"]),
            presets=presets,
            variants=tuple(data.get("variants", [{}])),
            rates=str(data.get("rates", "default")),
            compositions="all" if compositions == "all" else tuple(compositions),
            dvr=bool(data.get("dvr", False)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            path, f"not a suite ({type(error).__name__}: {error})", "See bench/suites/quick.toml"
        ) from error
    if suite.preset not in presets:
        raise unknown("preset", suite.preset, presets, of=str(path))
    if suite.rates not in ("default", "all"):
        raise DataError(path, f"rates = {suite.rates!r}", 'Use "default" or "all"')
    if not suite.datasets or not suite.seeds:
        raise DataError(path, "no datasets or seeds in it", "Name at least one of each")
    if not suite.methods and not suite.dvr:
        raise DataError(path, "has nothing to run", "Name methods, or write dvr = true")
    if isinstance(compositions, str) and compositions != "all":
        raise DataError(path, f"compositions = {compositions!r}", 'Write "all", or a list of names')
    return suite
