"""Suites: named sets of datasets, methods, option variants, seeds and presets, as TOML files."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, StrictBool, ValidationInfo
from pydantic.dataclasses import dataclass

from econgs_bench.bench.store.records import SAMPLED
from econgs_bench.bench.suites.edits import edit_of
from econgs_bench.bench.suites.ladders import Ladder, ladder_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.toml import read_toml

FOLDER = Path(__file__).parent


Count = Annotated[int, Field(strict=True, ge=1)]
Pixels = Annotated[int, Field(strict=True, ge=1, le=16_384)]
ViewCount = Annotated[int, Field(strict=True, ge=1, le=100_000)]
# NumPy takes no other seeds.
Seed = Annotated[int, Field(strict=True, ge=0, lt=2**32)]
_CONFIG = ConfigDict(extra="forbid", hide_input_in_errors=True)


@dataclass(frozen=True, config=_CONFIG)
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

    train_views: ViewCount
    test_views: ViewCount
    width: Pixels
    height: Pixels
    prerendered_limit: Annotated[int, Field(strict=True, ge=1)]
    cloud_points: Annotated[int, Field(strict=True, ge=1, le=100_000_000)] = 10_000
    like: str = ""
    budget: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] = 1.0


VIEWS = {
    "quick": ViewPreset(42, 16, 128, 128, 200),
    "standard": ViewPreset(92, 181, 400, 400, 400),
    "paper": ViewPreset(92, 181, 800, 800, 800),
}
"""Presets of every suite, unless it declares its own of that name; "paper" is the published protocol."""


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise ValueError("is no list of names")
    return tuple(value)


def _choices(value: Any) -> tuple[tuple[str, ...], ...]:
    """A list of names is one choice of scenes, a list of lists several."""
    several = isinstance(value, list | tuple) and [one for one in value if isinstance(one, list | tuple)]
    if several and len(several) < len(value):
        raise ValueError("scenes are names, or lists of names, not both")
    return tuple(map(_names, several)) if several else (_names(value),)


def _compositions(value: Any) -> Literal["all"] | tuple[str, ...]:
    if value == "all":
        return "all"
    if isinstance(value, str):
        raise ValueError('Write "all", or a list of names')
    return _names(value)


def _ladders(value: Any, info: ValidationInfo) -> Any:
    """Ladders as they are, or from a file's tables."""
    if not isinstance(value, list):
        return value
    path = (info.context or {}).get("path", "suite")
    try:
        return tuple(ladder_of(table, str(path)) for table in value)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"ladders: {type(error).__name__}: {error}"
        raise DataError(path, reason, "See bench/suites/stability.toml") from error


@dataclass(frozen=True, config=_CONFIG)
class Suite:
    """The content of a suite file.

    Attributes:
        name: of the file, without its suffix; no key of it.
        datasets: dataset name -> choices of scenes that run together: names of scenes, or of compositions
            with their scenes (empty: all scenes).
        stand_ins: dataset -> the procedural one that takes its place where its data are missing; "": none,
            the dataset does not run there.
        train_views: numbers of training views to fit with; empty: the preset's.
        methods: names. Methods in ``optional`` run where they are registered.
        compositions: compositions of the scenes that are measured: names, "all", or none.
        dvr: time direct volume rendering of each scene, and its memory.
        parsimony: measure the lossless size of each classified volume, and how many Gaussians each default
            model can drop.
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

    title: str
    datasets: Annotated[Mapping[str, Annotated[Any, AfterValidator(_choices)]], Field(min_length=1)]
    preset: str
    methods: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)] = (0,)
    presets: Mapping[str, ViewPreset] = field(default_factory=dict)
    variants: Annotated[tuple[Mapping[str, Mapping[str, Any]], ...], Field(min_length=1)] = ({},)
    rates: Literal["default", "all"] = "default"
    lengths: tuple[Annotated[float, Field(strict=True, gt=0.0, le=1000.0)], ...] = ()
    compositions: Annotated[Any, AfterValidator(_compositions)] = ()
    dvr: StrictBool = False
    parsimony: StrictBool = False
    stand_ins: Mapping[str, str] = field(default_factory=dict)
    train_views: tuple[ViewCount, ...] = ()
    edits: tuple[str, ...] = ()
    chains: tuple[str, ...] = ()
    sampled: Count = SAMPLED
    ladders: Annotated[tuple[Ladder, ...], BeforeValidator(_ladders)] = ()
    repeats: tuple[Seed, ...] = ()
    threads: Count | None = None
    name: str = ""

    def present(self, available: Collection[str]) -> dict[str, tuple[tuple[str, ...], ...]]:
        """The datasets to run where those ``available`` have data: stand-ins take the places of others."""
        datasets: dict[str, tuple[tuple[str, ...], ...]] = {}
        for name, scenes in self.datasets.items():
            if source := self.source(name, available):
                datasets.setdefault(source, scenes)
        return datasets

    def source(self, name: str, available: Collection[str]) -> str:
        """The dataset that runs for one of the suite's where those ``available`` have data; "": none."""
        return name if name in available else self.stand_ins.get(name, name)


_KEYS = [key.name for one in (Suite, ViewPreset) for key in fields(one) if key.name != "name"]


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
    suite = read_toml(path, Suite, "See bench/suites/quick.toml", _KEYS)
    if suite.name:
        raise DataError(path, "unknown key name", "The file's own name is that of the suite")
    suite = replace(suite, name=path.stem, presets={**VIEWS, **suite.presets})
    _check(path, suite)
    return suite


def _check(path: Path, suite: Suite) -> None:
    """What keys say about each other."""
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
