"""Datasets as plans and views jobs read them: names, numbers of views, views, transfer functions."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.store.records import Request
from econgs_bench.bench.suites.edits import edit_of, edits_of
from econgs_bench.bench.suites.stress import part_of, stress_of
from econgs_bench.bench.suites.suite import ViewPreset
from econgs_bench.datasets.camera_paths import icosphere
from econgs_bench.datasets.catalogue.entries import built_in, own_files
from econgs_bench.datasets.edits import Edit, changes_transfer, edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.naming import split
from econgs_bench.datasets.render_views import Finer, finer_views, views_of
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.unseen import transfer_distance
from econgs_bench.datasets.views import Split, ViewRequest, ViewSet

_BINS = 128  # of a recorded transfer function


def absolute(name_or_path: str) -> str:
    """A catalogue name unchanged; a path (and its choices within the file) made absolute, for any process.

    Raises:
        DataError: a path is no text (bytes that are not UTF-8), which no record can hold.
    """
    try:
        os.path.abspath(name_or_path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise DataError(name_or_path, "its path is not UTF-8", "Rename the file or folder") from error
    if name_or_path in (own := own_files()):
        return str(own[name_or_path])
    path, choices = split(name_or_path)
    if name_or_path.partition("@")[0] in built_in() or not path.exists():
        return name_or_path
    return f"{path.resolve()}:{choices}" if choices else str(path.resolve())


def request(dataset: Dataset, scene_name: str, preset: ViewPreset, samples: int | None = None) -> Request:
    """The views of a dataset that a preset asks for.

    Args:
        dataset: with volumes, or pre-rendered.
        scene_name: one of its basic scenes.
        preset: numbers and size of views.
        samples: rays a pixel of rendered views; default: the dataset's.

    Raises:
        DataError: its pre-rendered views cannot be read, or have no size that the preset can use; or there
            is no such number of training cameras around a volume.
    """
    scene = dataset.scene(scene_name)
    native = None if scene.views_folder is None else _native_size(scene.views_folder)
    if native is None:
        icosphere(preset.train_views)  # raises where no cameras stand so
    width, height = view_size(preset, native)
    if native is not None:
        samples = 1
    elif samples is None:
        samples = dataset.samples
    return Request(
        train_views=preset.train_views,
        test_views=preset.test_views,
        width=width,
        height=height,
        samples=samples,
    )


def view_size(preset: ViewPreset, native: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height to ask for: the preset's, or a whole fraction of pre-rendered views' own size.

    Raises:
        DataError: no whole factor brings the views under the preset's limit.
    """
    if native is None:
        return preset.width, preset.height
    width, height = native
    limit = preset.prerendered_limit
    for factor in range(1, max(native) + 1):
        if width % factor == 0 and height % factor == 0 and max(width, height) // factor <= limit:
            return width // factor, height // factor
    raise DataError(
        f"views of {width}x{height}",
        f"no whole factor divides them to at most {limit} pixels",
        "Resize them to a size with small factors, or use a larger preset",
    )


def views(
    dataset: Dataset, scene: str, request: Request, split: Split, edit: str = "", stress: str = ""
) -> ViewSet:
    """Ground-truth views of a basic scene or of a composition, edited or not; cached if possible."""
    edits = _edits(dataset, scene, edit)
    return views_of(dataset, scene, view_request(request, split, stress), edit=edits)


def finer(
    dataset: Dataset, scene: str, request: Request, split: Split, edit: str = "", stress: str = ""
) -> Finer:
    """Some of those views with other rays; of a dataset with volumes."""
    edits = _edits(dataset, scene, edit)
    return finer_views(dataset, scene, view_request(request, split, stress), edit=edits)


def _edits(dataset: Dataset, scene: str, edit: str) -> dict[str, Edit]:
    return edits_of([part.name for part in dataset.parts(scene)], edit)


def edit_distance(dataset: Dataset, scene: str, edit: str) -> float | None:
    """Distance of a scene's or composition's transfer functions from the edited ones; None without an edit
    of their opacities or values.
    """
    parts, changes = dataset.parts(scene), _edits(dataset, scene, edit)
    if not any(changes_transfer(change) or change.opacity is not None for change in changes.values()):
        return None
    after = [edited(part, changes[part.name]) if part.name in changes else part for part in parts]
    return transfer_distance(parts, after)


def stressed(dataset: Dataset, scene_name: str, stress: str) -> Dataset:
    """The dataset with the definition of a scene under stress; its cameras stay where they were.

    Raises:
        DataError: the scene does not allow that stress.
    """
    values = stress_of(part_of(stress, "truth"))
    if not values:
        return dataset
    frame = dataset.frame
    edits = edit_of(scene_name, " ".join(f"{name}={value}" for name, value in values.items()))
    scene = edited(dataset.scene(scene_name), edits[scene_name])
    scenes = tuple(scene if one.name == scene_name else one for one in dataset.scenes)
    return replace(dataset, scenes=scenes, framing=None if frame is None else lambda _: frame)


def transfer_table(transfer: TransferFunction, entries: int) -> NDArray[np.float64]:
    """(entries, 4) color, and opacity over one reference length, at equidistant normalised values."""
    table = transfer.classify(np.linspace(0.0, 1.0, entries))
    table[:, 3] = -np.expm1(-table[:, 3] * transfer.reference_length)
    return table


def transfer_summary(dataset: Dataset, scene: str, edit: str = "") -> dict[str, dict[str, list[list[float]]]]:
    """Basic scene -> its transfer function and isosurfaces, for a scene or a composition, edited or not.

    "transfer": color and opacity (of the reference length) of :data:`_BINS` equal bins of normalised values,
    at the highest opacity in each; "levels": normalised value and color of each isosurface. Empty for scenes
    that were rendered elsewhere.
    """
    changes = _edits(dataset, scene, edit)
    summary = {}
    for part in dataset.parts(scene) if dataset.kind == "volume" else ():
        scene_part = edited(part, changes[part.name]) if part.name in changes else part
        bins: list[list[float]] = []
        if scene_part.transfer is not None:
            fine = transfer_table(scene_part.transfer, _BINS * 16).reshape(_BINS, 16, 4)
            peaks = fine[np.arange(_BINS), fine[..., 3].argmax(axis=1)]
            bins = [[float(value) for value in row] for row in peaks.round(3)]
        levels = [[float(level.value), *map(float, level.color)] for level in scene_part.isosurfaces]
        summary[part.name] = {"transfer": bins, "levels": levels}
    return summary


def view_request(request: Request, split: Split, stress: str = "") -> ViewRequest:
    """A job's request, for one split."""
    values = stress_of(stress)
    width, height = (
        max(1, round(values.get("zoom", 1.0) * size)) for size in (request.width, request.height)
    )
    distance, step = values.get("distance", 1.0), values.get("step", 0.0)
    return ViewRequest(
        split, request.train_views, request.test_views, width, height, distance, step, request.samples
    )


def _native_size(folder: Path) -> tuple[int, int]:
    """Width and height of the first training picture."""
    from econgs_bench.datasets.cloud import warn_of_views
    from econgs_bench.datasets.png import open_picture
    from econgs_bench.datasets.posed_images import read_frames

    frames = read_frames(folder, "train")
    if not frames:
        raise DataError(folder, "has no training views", "Add pictures")
    _, picture = frames[0]
    warn_of_views(folder)
    with open_picture(picture) as image:
        return image.size
