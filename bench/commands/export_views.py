"""``bench export-views``: a dataset's training views and test cameras as folders that other trainers load."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from functools import partial
from pathlib import Path

from econgs_bench.bench.commands.arguments import add_samples, count, repeatable, seed, size
from econgs_bench.bench.store.store import aside_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.reports.progress import step


def export_views_arguments(parser: ArgumentParser) -> None:
    """What ``bench export-views`` takes."""
    parser.add_argument("dataset", help="name in the catalogue, or a path")
    parser.add_argument("--format", choices=("blender", "colmap", "colmap-text"), default="blender")
    parser.add_argument("--out", required=True, metavar="FOLDER", help="gets a new folder for each scene")
    repeatable(parser, "--scene", help="only this scene")
    parser.add_argument(
        "--pictures", choices=("rgba", "composited"),
        help="with alpha, or on the background; default: rgba (blender) or composited (colmap)",
    )  # fmt: skip
    parser.add_argument(
        "--preset", choices=("quick", "standard", "paper"), default="quick",
        help="numbers and size of views, points of the cloud (default: quick)",
    )  # fmt: skip
    parser.add_argument("--views", type=count, help="number of training views, instead of the preset's")
    parser.add_argument("--test-views", type=count, help="number of test cameras, instead of the preset's")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels, instead of the preset's")
    parser.add_argument("--seed", type=seed, default=0, help="of the initial cloud (default: 0)")
    add_samples(parser)


def export_views(options: Namespace) -> int:
    """Write a folder for each scene, whole or not at all: what ``bench run`` gives methods of its own."""
    from econgs_bench.bench.jobs.scene_views import view_request
    from econgs_bench.bench.plan import inputs
    from econgs_bench.bench.store.records import derived_seed
    from econgs_bench.bench.suites.suite import VIEWS
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.cloud import initial_cloud
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.datasets.render_views import announce_slow, cameras_of, views_of
    from econgs_bench.datasets.view_folders import write_cameras, write_training

    step(f"reading {options.dataset}")
    dataset = open_dataset(options.dataset)
    if dataset.kind == "volume":
        announce_slow()
    preset = VIEWS[options.preset]
    views, tests = options.views or preset.train_views, options.test_views or preset.test_views
    preset = replace(preset, train_views=views, test_views=tests)
    if options.size:
        width, height = options.size
        preset = replace(preset, width=width, height=height, prerendered_limit=max(width, height))
    samples = None if options.samples is None else samples_of(options.samples, "--samples")
    scenes = [dataset.scene(name) for name in options.scene] or list(dataset.scenes)
    out = Path(options.out)
    for scene in scenes:
        if (out / scene.name).exists():
            raise DataError(out / scene.name, "exists already", "Remove it, or choose another --out")
    for scene in scenes:
        request = inputs.request(dataset, scene.name, preset, samples)
        drawn = partial(step, f"drawing {dataset.name}/{scene.name}")
        train = views_of(dataset, scene.name, view_request(request, "trainval"), progress=drawn)
        cameras = cameras_of(dataset, scene.name, view_request(request, "test"))
        cloud = initial_cloud(
            dataset, scene, preset.cloud_points, derived_seed("cloud", dataset.name, scene.name, options.seed)
        )
        out.mkdir(parents=True, exist_ok=True)
        with aside_of(out / scene.name) as aside:
            (aside / "test_cameras").mkdir(parents=True)
            write_training(aside, options.format, train, cloud, scene, options.pictures)
            write_cameras(aside / "test_cameras", options.format, cameras, cloud)
            aside.rename(out / scene.name)
        counts = f"{len(train)} training views, {len(cameras)} test cameras, {len(cloud)} points"
        print(f"{out / scene.name}: {counts}")
    return 0
