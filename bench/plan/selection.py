"""A selection of datasets, scenes and methods; its datasets are checked and hashed before any job starts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from econgs_bench.bench.plan import inputs
from econgs_bench.bench.store.records import Request
from econgs_bench.bench.suites.suite import Suite, ViewPreset
from econgs_bench.datasets.catalogue import list_datasets, open_dataset
from econgs_bench.datasets.catalogue.evaluation import check_choice
from econgs_bench.datasets.content import composition_hash, fingerprint
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.scene import BasicScene, Dataset


@dataclass(frozen=True)
class Selection:
    """A suite, narrowed or widened by command-line options.

    Attributes:
        scenes: names of basic scenes, or of compositions (which bring their basic scenes along).
        composed: every composition of the scenes, whatever the suite says.
        samples: rays a pixel of rendered views; None: the datasets' own.
        overrides: method -> option -> value, from ``--set``; on top of the suite's variants.
    """

    suite: Suite
    datasets: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    composed: bool = False
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    preset: str = ""
    split: str = "test"
    samples: int | None = None
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    device: str = "cpu"
    plugins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Subset:
    """Scenes and compositions of one dataset as a plan needs them, without the volumes.

    Attributes:
        source: name in the catalogue, or absolute path.
        hashes: basic scene -> content hash, in the order of the dataset.
        compositions: composition -> its basic scenes, all of which are in ``hashes``.
        request: the views of each scene.
        scenes: definitions of the basic scenes, in the order of ``hashes``.
    """

    source: str
    name: str
    kind: Literal["volume", "views"]
    hashes: Mapping[str, str]
    compositions: Mapping[str, tuple[str, ...]]
    request: Request
    scenes: tuple[BasicScene, ...] = ()

    def content(self, name: str) -> str:
        """Content hash of a basic scene or of a composition."""
        if name in self.compositions:
            return composition_hash([self.hashes[part] for part in self.compositions[name]])
        return self.hashes[name]


def subsets(selection: Selection, preset: ViewPreset) -> list[Subset]:
    """Open, check and hash every dataset of a selection; each is released before the next one is opened.

    Raises:
        UnknownName: a dataset or scene that is not there.
        DataError: data that cannot be used; all such datasets are named at once.
    """
    suite = selection.suite
    present = suite.present(_available(suite))
    sources = selection.datasets or tuple(present)
    if not sources:
        raise DataError(
            f"suite {suite.name}",
            "none of its datasets has data here",
            "`bench fetch NAME` gets one of `bench list datasets`; or set BENCH_DATA",
        )
    compositions: Literal["all"] | tuple[str, ...] = "all" if selection.composed else suite.compositions
    result, problems = [], []
    all_scenes: set[str] = set()
    all_compositions: set[str] = set()
    for name in sources:
        try:
            source = inputs.absolute(name)
            dataset = _opened(selection, source)
            names = {*(scene.name for scene in dataset.scenes), *dataset.compositions}
            all_scenes |= names
            all_compositions |= set(dataset.compositions)
            choices: Sequence[Sequence[str]] = present.get(name, ((),))
            if selection.scenes:
                choice = [scene for scene in selection.scenes if scene in names]
                choices = [choice] if choice else []
            result += [
                _subset(
                    source,
                    dataset,
                    choice,
                    compositions,
                    replace(preset, train_views=count),
                    selection.samples,
                )
                for choice in choices
                for count in suite.train_views or (preset.train_views,)
            ]
        except DataError as error:
            problems.append(error)
    if problems:
        raise problems[0] if len(problems) == 1 else _together(problems, len(sources))
    for scene in selection.scenes:
        if scene not in all_scenes:
            raise unknown("scene", scene, all_scenes, of=", ".join(sources))
    for name in () if compositions == "all" or selection.datasets else compositions:
        if name not in all_compositions:
            raise unknown("composition", name, all_compositions, of=f"suite {suite.name}")
    return result


def usual_sources(selection: Selection, names: Collection[str]) -> set[str]:
    """Sources (:attr:`Subset.source`) of some of a suite's datasets, or of what stands in for them."""
    available = _available(selection.suite)
    present = (selection.suite.source(name, available) for name in names)
    return {inputs.absolute(name) for name in present if name}


def subset_of_scene(selection: Selection, preset: ViewPreset, place: str) -> Subset | None:
    """The subset of the one scene "dataset/scene"; None if the command line leaves it out.

    Raises:
        UnknownName, DataError: as :func:`subsets`.
    """
    name, _, scene = place.rpartition("/")
    if selection.datasets and name not in selection.datasets:
        return None
    if selection.scenes and scene not in selection.scenes:
        return None
    source = inputs.absolute(name)
    return _subset(source, _opened(selection, source), (scene,), (), preset, selection.samples)


def _opened(selection: Selection, source: str) -> Dataset:
    """A dataset; one for evaluation alone only where it is measured on test views."""
    dataset = open_dataset(source)
    if selection.split == "val":
        check_choice(dataset)
    return dataset


def _available(suite: Suite) -> set[str]:
    """Those of a suite's datasets that have data here; what is no catalogue name is taken as a path."""
    lacking = {info.name for info in list_datasets() if not info.available} if suite.stand_ins else set()
    return {name for name in suite.datasets if lacking.isdisjoint(name.split("+"))}


def _subset(
    source: str,
    dataset: Dataset,
    choice: Sequence[str],
    wish: Literal["all"] | tuple[str, ...],
    preset: ViewPreset,
    samples: int | None,
) -> Subset:
    """Scenes and compositions of a choice (empty: all scenes), and those of the wish that they make up."""
    names = choice or [scene.name for scene in dataset.scenes]
    within = {part.name for name in names for part in dataset.parts(name)}
    compositions = {
        name: parts
        for name, parts in dataset.compositions.items()
        if name in choice or ((wish == "all" or name in wish) and within.issuperset(parts))
    }
    scenes = [scene.name for scene in dataset.scenes if scene.name in within]
    return Subset(
        source,
        dataset.name,
        dataset.kind,
        {scene: fingerprint(dataset, scene) for scene in scenes},
        compositions,
        inputs.request(dataset, scenes[0], preset, samples),
        tuple(dataset.scene(scene) for scene in scenes),
    )


def _together(problems: Sequence[DataError], count: int) -> DataError:
    """One error that names the problem of each of several datasets."""
    kind = UnknownName if all(isinstance(error, UnknownName) for error in problems) else DataError
    reasons = "; ".join(f"({number}) {error}" for number, error in enumerate(problems, 1))
    return kind(f"{len(problems)} of {count} datasets", f"cannot be used: {reasons}", "Nothing was run")
