"""``bench render --contact-sheet``: all scenes of a dataset on one picture, with their transfer functions."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    from econgs_bench.datasets.scene import BasicScene, Dataset
    from econgs_bench.reports.pictures.contact_sheet import Tile

_ENTRIES = 2048  # of a drawn transfer function


def contact_sheets(options: Namespace) -> int:
    """Write one sheet per dataset; without a name, of every dataset of the catalogue that is here."""
    from econgs_bench.datasets.catalogue import list_datasets, open_dataset
    from econgs_bench.datasets.render_views import announce_slow

    if options.model:
        raise DataError("--contact-sheet", "shows ground truth only", "Leave --model out")
    folder = Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.dataset or [info.name for info in list_datasets() if info.available]:
        dataset = open_dataset(name)
        if dataset.kind == "volume":
            announce_slow()
        step(f"reading {dataset.name}")
        if options.automatic:
            dataset = _with_automatic(dataset)
        path = folder / f"{dataset.name}.png"
        draw_sheet(dataset, path, options.views or 3, options.size or (140, 140), options.scene)
        print(path)
    return 0


def draw_sheet(
    dataset: Dataset,
    path: Path,
    views: int,
    size: tuple[int, int],
    scenes: Sequence[str] = (),
    notes: Mapping[str, str] | None = None,
) -> None:
    """Write the contact sheet of a dataset.

    Args:
        dataset: any dataset.
        path: PNG file to write.
        views: number of views of each scene.
        size: width and height of a view in pixels.
        scenes: names of scenes and compositions; none: all.
        notes: basic scene -> text beside its name, instead of its variable.

    Raises:
        UnknownName: no such scene.
        DataError: the data cannot be read.
    """
    from econgs_bench.datasets.png import write_png
    from econgs_bench.reports.pictures.contact_sheet import contact_sheet

    names = scenes or [*(scene.name for scene in dataset.scenes), *dataset.compositions]
    tiles = []
    for number, name in enumerate(names):
        step(f"drawing the sheet of {dataset.name}", number, len(names))
        tiles.append(_tile(dataset, name, views, size, notes or {}))
    sheet = contact_sheet(f"{dataset.name}: {dataset.title}", tiles)
    write_png(path, sheet.astype(np.float32) / np.float32(255.0))


def _tile(dataset: Dataset, name: str, count: int, size: tuple[int, int], notes: Mapping[str, str]) -> Tile:
    from econgs_bench.bench.jobs.scene_views import views
    from econgs_bench.bench.plan.inputs import request
    from econgs_bench.bench.suites.suite import ViewPreset
    from econgs_bench.reports.pictures.contact_sheet import Tile

    preset = ViewPreset(12, count, *size, prerendered_limit=max(size))
    parts = dataset.parts(name)
    truth = views(dataset, name, request(dataset, parts[0].name, preset), "test")
    pictures = tuple(truth.composited(index) for index in range(len(truth)))
    coverage = float(truth.images[..., 3].mean())
    if name in dataset.compositions:
        return Tile(name, " + ".join(part.name for part in parts), pictures, coverage)
    scene = parts[0]
    if dataset.kind == "views":
        return Tile(name, "rendered elsewhere", pictures, coverage)
    scale = dataset.volume(scene.variable).value_range
    note = notes.get(name, scene.variable)
    histogram, transfer, levels = _curves(dataset, scene)
    return Tile(name, note, pictures, coverage, histogram, transfer, levels, scale)


def _curves(dataset: Dataset, scene: BasicScene):  # type: ignore[no-untyped-def]
    """Histogram, transfer function and levels of a basic scene."""
    from econgs_bench.bench.jobs.scene_views import transfer_table
    from econgs_bench.datasets.auto_transfer import statistics

    histogram = statistics(dataset.volume(scene.variable)).count
    if scene.transfer is None:
        return histogram, None, tuple((level.value, level.color) for level in scene.isosurfaces)
    return histogram, transfer_table(scene.transfer, _ENTRIES), ()


def _with_automatic(dataset: Dataset) -> Dataset:
    """The dataset with the automatic scenes of its variables after its own."""
    from econgs_bench.datasets.auto_transfer import automatic_scenes

    automatic = [
        replace(scene, name=f"auto {variable} {scene.name}")
        for variable in dataset.volumes
        for scene in automatic_scenes(dataset.volume(variable))
    ]
    return replace(dataset, scenes=(*dataset.scenes, *automatic))
