"""``bench scenes``: transfer functions for a volume file, in a TOML file to edit, and their contact sheet."""

from __future__ import annotations

import shlex
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.commands.arguments import count, size
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    from econgs_bench.datasets.scene import Dataset

EMPTY, SAME, BOX = 0.005, 0.5, 0.8
"""Visible share of a nearly empty scene, overlap of two alike ones, and covered share of a solid box."""

_SAMPLES = 128  # along an axis


@dataclass(frozen=True)
class Account:
    """What one scene shows.

    Attributes:
        scene: its name.
        share: visible share of the voxels.
        overlap: largest share of visible voxels in common with another scene of the same grid, of the
            one that shows less.
        other: name of that scene; "" where there is none.
        words: what is wrong with it; "" for nothing.
    """

    scene: str
    share: float
    overlap: float
    other: str
    words: str

    def __str__(self) -> str:
        text = f"{100 * self.share:.1f} % of the voxels visible"
        if self.other:
            text += f", at most {100 * self.overlap:.0f} % shared (with {self.other})"
        return f"{self.words}: {text}" if self.words else text


def scenes_arguments(parser: ArgumentParser) -> None:
    """What ``bench scenes`` takes."""
    parser.add_argument("file", metavar="FILE", help="a volume file, or the TOML file of an earlier call")
    parser.add_argument(
        "--out", metavar="NAME.toml", help="file to write, which is never overwritten (default: here)"
    )
    parser.add_argument(
        "--range", metavar="LOW,HIGH", help='values to show, or "all" (default: all but outliers)'
    )
    parser.add_argument("--missing", metavar="V,V...", help="values that stand for missing data")
    parser.add_argument("--views", type=count, help="number of views of each scene (default: 3)")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels of a view (default: 200)")


def scenes(options: Namespace) -> int:
    """Write an entry for a volume file unless there is one, and draw its contact sheet."""
    from econgs_bench.bench.commands.sheets import draw_sheet
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.catalogue.proposal import write_entry
    from econgs_bench.datasets.render_views import announce_slow

    announce_slow()
    step(f"reading {options.file}")
    entry = Path(options.file).expanduser()
    if entry.suffix == ".toml":
        if options.range or options.missing:
            raise DataError("--range, --missing", "are for a volume file", f"Write the keys in {entry}")
        if options.out:
            raise DataError("--out", "is for a volume file", f"Leave it out: {entry} stays as it is")
        dataset = open_dataset(str(entry))
    else:
        entry, dataset = _entry(options)
        if not entry.exists():
            step("proposing scenes")
            found, dataset = len(dataset.scenes), without_repeats(dataset)
            write_entry(dataset, entry)
            number = len(dataset.scenes)
            less = f"; left out {found - number} that show much the same" if number < found else ""
            print(f"{entry}: {number} scene{'s' if number > 1 else ''} proposed{less}")
        else:
            print(f"{entry}: is there already and stays as it is")
        for line in _steps(dataset):
            print(line)
        dataset = open_dataset(str(entry))
    step("looking at what the scenes show")
    accounts = account(dataset)
    notes = {one.scene: str(one) for one in accounts}
    sheet = entry.with_suffix(".png")
    draw_sheet(dataset, sheet, options.views or 3, options.size or (200, 200), notes=notes)
    print(f"{sheet}: the contact sheet")
    width = max(len(one.scene) for one in accounts)
    for one in accounts:
        print(f"  {one.scene:<{width}}  {one}")
    name = shlex.quote(str(entry))
    print(f"Edit {name}, then look again:  bench scenes {name}")
    print(f"Run an experiment on it:  bench run quick --dataset {name}")
    return 0


def _steps(dataset: Dataset) -> Iterator[str]:
    """A line for each file with several time steps."""
    from econgs_bench.datasets.catalogue.files import FileField
    from econgs_bench.datasets.readers import list_variables

    requests = {f.request.path: f.request for f in dataset.volumes.values() if isinstance(f, FileField)}
    for path, request in requests.items():
        steps = max((variable.steps for variable in list_variables(path)), default=1)
        if steps > 1:
            yield (
                f"{path}: has {steps} time steps, 0 to {steps - 1}; this is step {request.step or 0}. "
                f"Others: bench scenes {shlex.quote(f'{path}:step={steps - 1}')}"
            )


def _name(options: Namespace) -> str:
    """The file with the choices of the options: ``PATH:variable=T,range=0,100``."""
    from econgs_bench.datasets.readers.naming import parse_numbers, parse_range, split

    choices = []
    if options.range is not None:
        parse_range(options.range)
        choices.append(f"range={options.range}")
    if options.missing is not None:
        parse_numbers("missing", options.missing)
        choices.append(f"missing={options.missing}")
    if not choices:
        return str(options.file)
    return f"{options.file}{',' if split(options.file)[1] else ':'}{','.join(choices)}"


def _entry(options: Namespace) -> tuple[Path, Dataset]:
    """The entry's file, and the dataset with automatic scenes that it is to hold."""
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.catalogue.entries import names
    from econgs_bench.datasets.catalogue.files import FileField

    if options.out and not options.out.endswith(".toml"):
        raise DataError(options.out, "is no name of an entry", "Give it the suffix .toml")
    if options.file.partition("@")[0] in names():
        raise DataError(
            options.file, "is a dataset of the catalogue",
            f"Its sheet: bench render --contact-sheet {options.file}. For scenes of your own name a file",
        )  # fmt: skip
    dataset = open_dataset(_name(options))
    if not all(isinstance(field, FileField) for field in dataset.volumes.values()) or not dataset.volumes:
        raise DataError(options.file, "is no volume file", "Name a volume file or an entry (.toml)")
    return Path(options.out).expanduser() if options.out else Path(f"{dataset.name}.toml"), dataset


def account(dataset: Dataset) -> list[Account]:
    """What each scene of a dataset of volumes shows, by order of the scenes."""
    result: dict[str, Account] = {}
    for looks, common in _grids(dataset):
        np.fill_diagonal(common, -1.0)
        for i, one in enumerate(looks):
            j = int(common[i].argmax())
            other = looks[j].scene if len(looks) > 1 else ""
            overlap = max(float(common[i, j]), 0.0)
            words = []
            if one.share < EMPTY:
                words.append("nearly empty")
            if one.cover > BOX:
                words.append("a solid box")
            if overlap > SAME:
                words.append(f"shows much the same as {other}")
            result[one.scene] = Account(one.scene, one.share, overlap, other, ", ".join(words))
    return [result[scene.name] for scene in dataset.scenes]


def without_repeats(dataset: Dataset) -> Dataset:
    """The dataset without scenes that show much the same as one before them."""
    gone: set[str] = set()
    for looks, common in _grids(dataset):
        for i, one in enumerate(looks):
            if any(common[i, j] > SAME for j in range(i) if looks[j].scene not in gone):
                gone.add(one.scene)
    left = {
        name: tuple(part for part in parts if part not in gone)
        for name, parts in dataset.compositions.items()
    }
    scenes = tuple(scene for scene in dataset.scenes if scene.name not in gone)
    shown = {scene.variable for scene in scenes}
    return replace(
        dataset,
        scenes=scenes,
        compositions={name: parts for name, parts in left.items() if len(parts) > 1},
        volumes={name: volume for name, volume in dataset.volumes.items() if name in shown},
    )


class _Look(NamedTuple):
    """Name, visible share of the voxels and covered share of the box."""

    scene: str
    share: float
    cover: float


def _grids(dataset: Dataset) -> Iterator[tuple[list[_Look], NDArray[np.float64]]]:
    """The scenes of each grid, and how much of the visible voxels any two have in common."""
    from econgs_bench.datasets.framing import visible_voxels
    from econgs_bench.datasets.visibility import Samples, overlaps

    grids: dict[tuple[object, ...], list[tuple[_Look, NDArray[np.bool_]]]] = {}
    for variable in dict.fromkeys(scene.variable for scene in dataset.scenes):
        samples = Samples.of(dataset.volume(variable), _SAMPLES)
        key = (samples.values.shape, samples.distances)
        for scene in dataset.scenes:
            if scene.variable == variable:
                visible = visible_voxels(samples, scene)
                cover = samples.look(scene.transfer).cover if scene.transfer else 0.0
                look = _Look(scene.name, float(visible.sum() / samples.valid.sum()), cover)
                grids.setdefault(key, []).append((look, visible))
    for parts in grids.values():
        yield [look for look, _ in parts], overlaps([visible for _, visible in parts])
