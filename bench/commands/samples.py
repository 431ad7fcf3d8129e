"""``bench samples``: what rays a pixel are worth, against a finer truth."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from dataclasses import replace

from econgs_bench.bench.commands.arguments import FORMATS, count, repeatable, size
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step

NUMBERS = (1, 4, 9, 16, 64, 0)
"""Samples that are compared; 0: as many as each pixel needs."""
METRICS = ("psnr", "ssim", "flip", "delta_e_uv")


def samples_arguments(parser: ArgumentParser) -> None:
    """What ``bench samples`` takes."""
    parser.add_argument("dataset", help="name in the catalogue, or a path")
    repeatable(parser, "--scene", help="only this scene")
    parser.add_argument("--views", type=count, help="number of test views (default: 4)")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: 128)")
    parser.add_argument("--format", choices=FORMATS, default="md")


def samples(options: Namespace) -> int:
    """Print, for each scene and number of rays, its pictures' metrics against finer ones, and their cost."""
    import pandas as pd

    from econgs_bench.bench.commands.results import print_as
    from econgs_bench.bench.metrics import mean_scores
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.render_views import FLOOR_VIEWS, announce_slow, finer_views, live_renderer
    from econgs_bench.datasets.views import ViewRequest
    from econgs_bench.reports.schema import rays

    dataset = open_dataset(options.dataset)
    if dataset.kind == "views":
        raise DataError(dataset.name, "was rendered elsewhere", "Name a dataset with a volume")
    announce_slow()
    count = options.views or 2 * FLOOR_VIEWS
    width, height = options.size or (128, 128)
    rows = []
    for name in options.scene or [scene.name for scene in dataset.scenes]:
        request = ViewRequest("test", 12, count, width, height)
        step(f"drawing the finer views of {name}")
        truth = finer_views(dataset, name, request, count=count)
        background = dataset.parts(name)[0].background
        for number in NUMBERS:
            live = live_renderer(dataset, name, replace(request, samples=number))
            start = time.perf_counter()
            images = []
            for done, camera in enumerate(live.cameras):
                step(f"drawing {name} with {rays(number)} rays a pixel", done, len(live.cameras))
                images.append(live.render(camera))
            seconds = time.perf_counter() - start
            means = mean_scores(truth.finer, images, background, METRICS)
            rows.append(
                {
                    "scene": name,
                    "rays a pixel": rays(number),
                    **means,
                    "time a view [ms]": round(1e3 * seconds / len(images), 1),
                }
            )
    print_as(pd.DataFrame(rows), options.format)
    if options.format == "md":
        print("Against the same views at twice the size, with as many rays as they need, averaged.")
    return 0
