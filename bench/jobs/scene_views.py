"""Views of a scene as jobs ask for them: edited, under stress, for one split."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.store.records import Request
from econgs_bench.bench.suites.edits import edit_of, edits_of
from econgs_bench.bench.suites.stress import part_of, stress_of
from econgs_bench.datasets.edits import Edit, changes_transfer, edited
from econgs_bench.datasets.render_views import Finer, finer_views, views_of
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.unseen import transfer_distance
from econgs_bench.datasets.views import Split, ViewRequest, ViewSet

_BINS = 128  # of a recorded transfer function


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
