"""Suites: named sets of datasets, methods, option variants, seeds and presets, as TOML files."""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from bench.edits import edit_of
from bench.ladders import Ladder, ladder_of
from datasets.errors import DataError
from datasets.names import unknown

FOLDER = Path(__file__).parent / "suites"
SAMPLED = 100
"""Primitives of each scene whose attributes are recorded, unless a suite names another number."""


@dataclass(frozen=True)
class ViewPreset:
    """Views of a preset.

    Attributes:
        train_views, test_views: see :class:`datasets.views.ViewRequest`.
        width, height: pixels of rendered views.
        prerendered_limit: pre-rendered views keep their own size up to this many pixels along the
            longer side; larger ones are area-averaged by the smallest whole factor that fits.
        cloud_points: size of the initial cloud.
        like: the preset whose options and iterations methods take, where a suite gives its preset a name of
            its own; "" is the name.
        budget: share of the iterations that methods take, unless they are set.
    """

    train_views: int
    test_views: int
    width: int
    height: int
    prerendered_limit: int
    cloud_points: int = 10_000
    like: str = ""
    budget: float = 1.0


VIEWS = {
    "quick": ViewPreset(42, 16, 128, 128, 200),
    "standard": ViewPreset(92, 181, 400, 400, 400),
    "paper": ViewPreset(92, 181, 800, 800, 800),
}
"""Presets of every suite, unless it declares its own of that name; "paper" is the published protocol."""


@dataclass(frozen=True)
class Suite:
    """The content of a suite file.

    Attributes:
        datasets: dataset name -> choices of scenes that run together: names of scenes, or of compositions
            with their scenes (empty: all scenes).
        stand_ins: dataset -> the procedural one that takes its place where its data are missing; "": none,
            the dataset does not run there.
        train_views: numbers of training views to fit with; empty: the preset's.
        methods: names. Methods in ``optional`` run where they are registered.
        compositions: compositions of the scenes that are measured: names, "all", or none.
        dvr: time direct volume rendering of each scene, and its memory.
        parsimony: find out how many bytes the classified volume of each scene takes without loss, and what
            each model of the usual rate could do without.
        variants: sets of options, method -> option -> value; {} is the presets' own.
        rates: "default" (each method's own size) or "all" (the rate knobs' values).
        edits: changes of each basic scene, as "opacity=0.5 light=1,0,0". Models are edited and measured
            against the ground truth of the changed scene; scenes of pre-rendered views have none. Where an
            edit changes a transfer function and a method cannot do that, the trained scenes that come nearest
            are rendered together (:func:`datasets.unseen.recipe`).
        chains: changes of each composition, for its scenes in turn, as "opacity=0.5 | opacity=2".
        sampled: primitives of each scene whose attributes are recorded.
        ladders: runs under more and more stress, beside the usual ones.
        repeats: further seeds of a rung on which a method breaks, and of the first rung beside it.
        threads: most threads of a job, so that results do not depend on the number of cores; None: all cores.
    """

    name: str
    title: str
    datasets: Mapping[str, tuple[tuple[str, ...], ...]]
    methods: tuple[str, ...]
    optional: tuple[str, ...]
    seeds: tuple[int, ...]
    preset: str
    presets: Mapping[str, ViewPreset]
    variants: tuple[Mapping[str, Mapping[str, Any]], ...] = field(default=({},))
    rates: str = "default"
    compositions: Literal["all"] | tuple[str, ...] = ()
    dvr: bool = False
    parsimony: bool = False
    stand_ins: Mapping[str, str] = field(default_factory=dict)
    train_views: tuple[int, ...] = ()
    edits: tuple[str, ...] = ()
    chains: tuple[str, ...] = ()
    sampled: int = SAMPLED
    ladders: tuple[Ladder, ...] = ()
    repeats: tuple[int, ...] = ()
    threads: int | None = None

    def present(self, available: Collection[str]) -> dict[str, tuple[tuple[str, ...], ...]]:
        """The datasets to run where those ``available`` have data: stand-ins take the places of others."""
        datasets: dict[str, tuple[tuple[str, ...], ...]] = {}
        for name, scenes in self.datasets.items():
            source = name if name in available else self.stand_ins.get(name, name)
            if source:
                datasets.setdefault(source, scenes)
        return datasets


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


def _choices(scenes: list[Any]) -> tuple[tuple[str, ...], ...]:
    """A list of names is one choice of scenes, a list of lists several."""
    several = [choice for choice in scenes if isinstance(choice, list)]
    if several and len(several) < len(scenes):
        raise TypeError("scenes are names, or lists of names, not both")
    return tuple(map(tuple, several)) or (tuple(scenes),)


def _parse(path: Path, data: dict[str, Any]) -> Suite:
    keys = {field.name for field in fields(Suite)} - {"name"}
    for key in data:
        if key not in keys:
            raise unknown("key", key, keys, of=str(path))
    compositions = data.get("compositions", [])
    try:
        presets = {name: ViewPreset(**table) for name, table in data.get("presets", {}).items()}
        suite = Suite(
            name=path.stem,
            title=str(data["title"]),
            datasets={str(name): _choices(scenes) for name, scenes in data["datasets"].items()},
            methods=tuple(data.get("methods", ())),
            optional=tuple(data.get("optional", ())),
            seeds=tuple(int(seed) for seed in data.get("seeds", [0])),
            preset=str(data["preset"]),
            presets={**VIEWS, **presets},
            variants=tuple(data.get("variants", [{}])),
            rates=str(data.get("rates", "default")),
            compositions="all" if compositions == "all" else tuple(compositions),
            dvr=bool(data.get("dvr", False)),
            parsimony=bool(data.get("parsimony", False)),
            stand_ins={str(name): str(other) for name, other in data.get("stand_ins", {}).items()},
            train_views=tuple(int(count) for count in data.get("train_views", ())),
            edits=tuple(str(edit) for edit in data.get("edits", ())),
            chains=tuple(str(chain) for chain in data.get("chains", ())),
            sampled=int(data.get("sampled", SAMPLED)),
            ladders=tuple(ladder_of(table, str(path)) for table in data.get("ladders", ())),
            repeats=tuple(int(seed) for seed in data.get("repeats", ())),
            threads=int(data["threads"]) if "threads" in data else None,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            path, f"not a suite ({type(error).__name__}: {error})", "See bench/suites/quick.toml"
        ) from error
    if suite.sampled < 1:
        raise DataError(path, f"sampled = {suite.sampled}", "Give a number of primitives, 1 or more")
    if suite.threads is not None and suite.threads < 1:
        raise DataError(path, f"threads = {suite.threads}", "Give a number of threads, 1 or more")
    for name in suite.stand_ins:
        if name not in suite.datasets:
            raise unknown("dataset", name, suite.datasets, of=f"{path} (stand_ins)")
    if suite.preset not in suite.presets:
        raise unknown("preset", suite.preset, suite.presets, of=str(path))
    for name, preset in presets.items():
        if not 0.0 < preset.budget <= 1.0:
            raise DataError(
                path, f"preset {name}: budget = {preset.budget!r}", "Give a share, above 0, at most 1"
            )
    if suite.rates not in ("default", "all"):
        raise DataError(path, f"rates = {suite.rates!r}", 'Use "default" or "all"')
    for edit in suite.edits:
        if not edit_of("scene", edit):
            raise DataError(path, "an edit that changes nothing", 'Write edits = ["opacity=0.5"]')
    for chain in suite.chains:
        if not any(edit_of("scene", part) for part in chain.split("|")):
            raise DataError(
                path, "a chain that changes nothing", 'Write chains = ["opacity=0.5 | opacity=2"]'
            )
    for ladder in suite.ladders:
        for name in ladder.datasets:
            if name not in suite.datasets:
                raise unknown("dataset", name, suite.datasets, of=f"{path} (ladder {ladder.name})")
    if len({ladder.name for ladder in suite.ladders}) < len(suite.ladders):
        raise DataError(path, "two ladders have one name", "Give each a name of its own")
    if not suite.datasets or not suite.seeds:
        raise DataError(path, "no datasets or seeds in it", "Name at least one of each")
    if not suite.methods and not suite.dvr:
        raise DataError(path, "has nothing to run", "Name methods, or write dvr = true")
    if isinstance(compositions, str) and compositions != "all":
        raise DataError(path, f"compositions = {compositions!r}", 'Write "all", or a list of names')
    return suite
