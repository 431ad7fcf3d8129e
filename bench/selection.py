"""What is asked for, and what it names: datasets opened, checked and hashed before any job starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from bench import inputs
from bench.records import Request, hash_of
from bench.suites import Suite, ViewPreset
from datasets.catalogue import list_datasets, open_dataset
from datasets.errors import DataError, UnknownName
from datasets.names import unknown
from datasets.scene import Dataset


@dataclass(frozen=True)
class Selection:
    """What is asked for: a suite, narrowed or widened by command-line options.

    Attributes:
        scenes: names of basic scenes, or of compositions (which bring their basic scenes along).
        composed: every composition of the scenes chosen, whatever the suite says.
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
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    device: str = "cpu"
    plugins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chosen:
    """A dataset as a plan needs it; its volumes are not held.

    Attributes:
        source: name in the catalogue, or absolute path.
        hashes: basic scene -> content hash, in the order of the dataset.
        compositions: composition -> its basic scenes, all of which are in ``hashes``.
        request: the views wanted of each scene.
    """

    source: str
    name: str
    kind: Literal["volume", "views"]
    hashes: Mapping[str, str]
    compositions: Mapping[str, tuple[str, ...]]
    request: Request

    def content(self, name: str) -> str:
        """Content hash of a basic scene or of a composition."""
        if name in self.compositions:
            return hash_of({"composition": [self.hashes[part] for part in self.compositions[name]]})
        return self.hashes[name]


def chosen_datasets(selection: Selection, preset: ViewPreset) -> list[Chosen]:
    """Open, check and hash every dataset that is asked for; each is let go before the next is opened.

    Raises:
        UnknownName: a dataset or scene that is not there.
        DataError: data that cannot be used; all such datasets are named at once.
    """
    suite = selection.suite
    present = suite.present(_available(suite))
    sources = selection.datasets or tuple(present)
    if not sources:
        raise DataError(
            f"suite {suite.name}", "none of its datasets has data here", "Set BENCH_DATA, or name a --dataset"
        )
    wanted: Literal["all"] | tuple[str, ...] = "all" if selection.composed else suite.compositions
    chosen, problems = [], []
    scenes_known: set[str] = set()
    compositions_known: set[str] = set()
    for name in sources:
        try:
            source = inputs.absolute(name)
            dataset = open_dataset(source)
            known = {*(scene.name for scene in dataset.scenes), *dataset.compositions}
            scenes_known |= known
            compositions_known |= set(dataset.compositions)
            choices: Sequence[Sequence[str]] = present.get(name, ((),))
            if selection.scenes:
                named = [scene for scene in selection.scenes if scene in known]
                choices = [named] if named else []
            chosen += [
                _choose(source, dataset, choice, wanted, replace(preset, train_views=count))
                for choice in choices
                for count in suite.train_views or (preset.train_views,)
            ]
        except DataError as error:
            problems.append(error)
    if problems:
        raise problems[0] if len(problems) == 1 else _together(problems, len(sources))
    for scene in selection.scenes:
        if scene not in scenes_known:
            raise unknown("scene", scene, scenes_known, of=", ".join(sources))
    for name in () if wanted == "all" or selection.datasets else wanted:
        if name not in compositions_known:
            raise unknown("composition", name, compositions_known, of=f"suite {suite.name}")
    return chosen


def _available(suite: Suite) -> set[str]:
    """Those of a suite's datasets that have data here; what is no catalogue name is taken as a path."""
    lacking = {info.name for info in list_datasets() if not info.available} if suite.stand_ins else set()
    return set(suite.datasets) - lacking


def _choose(
    source: str,
    dataset: Dataset,
    named: Sequence[str],
    wanted: Literal["all"] | tuple[str, ...],
    preset: ViewPreset,
) -> Chosen:
    """The scenes and compositions of one dataset: those named (else all scenes), and what they make up."""
    names = named or [scene.name for scene in dataset.scenes]
    within = {part.name for name in names for part in dataset.parts(name)}
    compositions = {
        name: parts
        for name, parts in dataset.compositions.items()
        if name in named or ((wanted == "all" or name in wanted) and within.issuperset(parts))
    }
    scenes = [scene.name for scene in dataset.scenes if scene.name in within]
    return Chosen(
        source,
        dataset.name,
        dataset.kind,
        {scene: inputs.fingerprint(dataset, scene) for scene in scenes},
        compositions,
        inputs.request(dataset, scenes[0], preset),
    )


def _together(problems: Sequence[DataError], count: int) -> DataError:
    """One error that tells what is wrong with each of several datasets."""
    kind = UnknownName if all(isinstance(error, UnknownName) for error in problems) else DataError
    told = "; ".join(f"({number}) {error}" for number, error in enumerate(problems, 1))
    return kind(f"{len(problems)} of {count} datasets", f"cannot be used: {told}", "Nothing was run")
