"""Suites: named sets of datasets, methods, option variants, seeds and presets, as TOML files."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from econgs_bench.bench.store.records import SAMPLED
from econgs_bench.bench.suites.edits import edit_of
from econgs_bench.bench.suites.ladders import Ladder, ladder_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.toml import read_toml

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class ViewPreset:
    """Views of a preset.

    Attributes:
        train_views, test_views: see :class:`.datasets.views.ViewRequest`.
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


Count = Annotated[int, Field(ge=1)]
Pixels = Annotated[int, Field(ge=1, le=16_384)]
Views = Annotated[int, Field(ge=1, le=100_000)]
# NumPy takes no other seeds.
Seed = Annotated[int, Field(ge=0, lt=2**32)]


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ValueError("is no list of names")
    return tuple(value)


def _choices(value: Any) -> tuple[tuple[str, ...], ...]:
    """A list of names is one choice of scenes, a list of lists several."""
    several = isinstance(value, list) and [one for one in value if isinstance(one, list)]
    if several and len(several) < len(value):
        raise ValueError("scenes are names, or lists of names, not both")
    return tuple(map(_names, several)) if several else (_names(value),)


def _compositions(value: Any) -> Literal["all"] | tuple[str, ...]:
    if value == "all":
        return "all"
    if isinstance(value, str):
        raise ValueError('Write "all", or a list of names')
    return _names(value)


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, hide_input_in_errors=True)


class _Views(_Part):
    """A preset of a suite file (:class:`ViewPreset`)."""

    train_views: Views
    test_views: Views
    width: Pixels
    height: Pixels
    prerendered_limit: Pixels
    cloud_points: Annotated[int, Field(ge=1, le=100_000_000)] = 10_000
    like: str = ""
    budget: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class _File(_Part):
    """A suite file (:class:`Suite`)."""

    title: str
    datasets: Annotated[dict[str, Annotated[Any, AfterValidator(_choices)]], Field(min_length=1)]
    methods: list[str] = []
    optional: list[str] = []
    seeds: Annotated[list[Seed], Field(min_length=1)] = [0]
    preset: str
    presets: dict[str, _Views] = {}
    variants: Annotated[list[dict[str, dict[str, Any]]], Field(min_length=1)] = [{}]
    rates: Literal["default", "all"] = "default"
    lengths: list[Annotated[float, Field(gt=0.0)]] = []
    compositions: Annotated[Any, AfterValidator(_compositions)] = ()
    dvr: bool = False
    parsimony: bool = False
    stand_ins: dict[str, str] = {}
    train_views: list[Views] = []
    edits: list[str] = []
    chains: list[str] = []
    sampled: Count = SAMPLED
    ladders: list[dict[str, Any]] = []
    repeats: list[Seed] = []
    threads: Count | None = None


_KEYS = (*_File.model_fields, *_Views.model_fields)


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
        lengths: shares of a method's iterations that it is fitted with besides, each a whole schedule; a fit
            of another length has the method's own rate.
        edits: changes of each basic scene, as "opacity=0.5 light=1,0,0". Models are edited and measured
            against the ground truth of the changed scene; scenes of pre-rendered views have none. Where an
            edit changes a transfer function and a method cannot do that, the trained scenes that come nearest
            are rendered together (:func:`.datasets.unseen.recipe`).
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
    lengths: tuple[float, ...] = ()
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
    return _parse(path, read_toml(path, _File, "See bench/suites/quick.toml", _KEYS))


def _parse(path: Path, file: _File) -> Suite:
    presets = {name: ViewPreset(**table.model_dump()) for name, table in file.presets.items()}
    try:
        ladders = tuple(ladder_of(table, str(path)) for table in file.ladders)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"ladders: {type(error).__name__}: {error}"
        raise DataError(path, reason, "See bench/suites/stability.toml") from error
    suite = Suite(
        name=path.stem,
        title=file.title,
        datasets=file.datasets,
        methods=tuple(file.methods),
        optional=tuple(file.optional),
        seeds=tuple(file.seeds),
        preset=file.preset,
        presets={**VIEWS, **presets},
        variants=tuple(file.variants),
        rates=file.rates,
        lengths=tuple(file.lengths),
        compositions=file.compositions,
        dvr=file.dvr,
        parsimony=file.parsimony,
        stand_ins=file.stand_ins,
        train_views=tuple(file.train_views),
        edits=tuple(file.edits),
        chains=tuple(file.chains),
        sampled=file.sampled,
        ladders=ladders,
        repeats=tuple(file.repeats),
        threads=file.threads,
    )
    for name in suite.stand_ins:
        if name not in suite.datasets:
            raise unknown("dataset", name, suite.datasets, of=f"{path} (stand_ins)")
    if suite.preset not in suite.presets:
        raise unknown("preset", suite.preset, suite.presets, of=str(path))
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
    if not suite.methods and not suite.dvr:
        raise DataError(path, "has nothing to run", "Name methods, or write dvr = true")
    return suite
