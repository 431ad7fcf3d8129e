"""Time of a frame by resolution, end to end: the saved models of a run store, drawn in turns.

python -m tools.benchmarks.bench_drawing --runs DIR [--against METHOD] [--width N ...] [--turns N]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from econgs_bench.bench.api import Runs
from econgs_bench.bench.saved import load
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.render_views import cameras_of
from econgs_bench.datasets.views import ViewRequest
from econgs_bench.methods.interface import Model
from tools.benchmarks.turns import heading, interleaved, row

WIDTHS = (200, 400, 800)
PATH = ViewRequest("test", 42, 16, 200, 200)
"""The views that are drawn."""


def main() -> None:
    """Print a table per scene: milliseconds a frame of each method, and the ratios to one of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="store with models of several methods")
    parser.add_argument("--against", default="3dgs", help="method that ratios are relative to")
    parser.add_argument("--width", type=int, nargs="+", default=WIDTHS, help="of square pictures, in pixels")
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()
    results, store = Runs(options.runs).results, Store(options.runs)
    rows = results.query("kind == 'basic' and variant == '' and rate.isna() and status == 'ok'")
    rows = rows[rows["seed"] == rows["seed"].min()]
    for (dataset, scene), jobs in rows.groupby(["dataset", "scene"]):
        models = {
            str(name): load(store, job)[3] for name, job in zip(jobs["method"], jobs["job"], strict=True)
        }
        if options.against not in models:
            continue
        others = [name for name in models if name != options.against]
        ratios = [f"{name} / {options.against}" for name in others]
        heading(f"{dataset}/{scene}: ms a frame, median (shortest)", "width", *models, *ratios)
        path = cameras_of(open_dataset(str(dataset)), str(scene), PATH)
        for width in options.width:
            cameras = [camera.resized(width, width) for camera in path]
            ways = {name: Drawing(model, str(scene), cameras) for name, model in models.items()}
            times = interleaved(ways, options.turns, len(cameras))
            base = times[options.against].median
            row(width, *times.values(), *(f"{times[name].median / base:.2f}" for name in others))


class Drawing:
    """Draws all views of a scene when it is called, on white."""

    def __init__(self, model: Model, scene: str, cameras: Sequence[Camera]) -> None:
        self._model, self._scene, self._cameras = model, scene, cameras

    def __call__(self) -> None:
        for camera in self._cameras:
            self._model.render(camera, scenes=[self._scene], background=(1.0, 1.0, 1.0))


if __name__ == "__main__":
    main()
