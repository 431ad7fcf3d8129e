"""``bench render`` and ``bench score``: pictures to look at, and the metrics on any two folders of them."""

from __future__ import annotations

import re
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.bench.commands.arguments import (
    FORMATS,
    add_device,
    add_runs,
    add_samples,
    add_stored,
    count,
    repeatable,
    size,
)
from econgs_bench.bench.jobs.measure import premultiplied
from econgs_bench.bench.run.plugins import plugin_folders
from econgs_bench.bench.saved import load, pictures
from econgs_bench.bench.store.store import Store, aside_of
from econgs_bench.datasets.colors import hex_color
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    from econgs_bench.datasets.scene import Dataset
    from econgs_bench.methods.interface import Model

_NUMBERED = re.compile(r"\d{4,}\.png")


def render_arguments(parser: ArgumentParser) -> None:
    """What ``bench render`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument(
        "dataset", nargs="*",
        help="name in the catalogue, or a path; contact sheets: default all that are here",
    )  # fmt: skip
    repeatable(parser, "--scene", help="only this scene")
    parser.add_argument(
        "--views", type=count, help="number of views on the test path (default: 8; contact sheets: 3)"
    )
    parser.add_argument(
        "--size",
        type=size,
        metavar="WxH",
        help="pixels (default: 256, of pre-rendered views their own; contact sheets: 140)",
    )
    parser.add_argument(
        "--contact-sheet", action="store_true",
        help="one picture per dataset: small views of all scenes, with transfer functions over histograms",
    )  # fmt: skip
    parser.add_argument(
        "--automatic", action="store_true", help="contact sheets: the automatic transfer functions too"
    )
    parser.add_argument("--out", default="pictures", metavar="DIR", help="default: pictures")
    parser.add_argument("--model", metavar="JOB", help="an encode or measure job of --runs: render its model")
    repeatable(
        parser, "--edit", metavar="SCENE.WHAT=VALUE|FILE",
        help="show it edited: palette=#ff8800, light=headlight or x,y,z, or a factor: opacity, ambient, "
        "diffuse, specular, shininess; or a file that `bench view` saved",
    )  # fmt: skip
    parser.add_argument(
        "--truth", action="store_true", help="with --model: the ground truth beside, and PSNR"
    )
    add_samples(parser)
    add_device(parser)


def render(options: Namespace) -> int:
    """Write views on the test path as PNG files: of the ground truth, or of a finished model."""
    if options.contact_sheet:
        from econgs_bench.bench.commands.sheets import contact_sheets

        return contact_sheets(options)
    if options.truth and not options.model:
        raise DataError("--truth", "is for pictures of a model", "Add --model, or leave it out")
    if options.automatic:
        raise DataError("--automatic", "is for contact sheets", "Add --contact-sheet")
    if not options.dataset:
        raise DataError("bench render", "names no dataset", "Name one of `bench list datasets`, or a path")
    for name in options.dataset:
        _render(options, name)
    return 0


def _render(options: Namespace, dataset_name: str) -> None:
    from econgs_bench.bench.jobs.scene_views import view_request
    from econgs_bench.bench.metrics import evaluate
    from econgs_bench.bench.plan import inputs
    from econgs_bench.bench.store.records import Request
    from econgs_bench.bench.suites.edits import given_edits
    from econgs_bench.bench.suites.suite import ViewPreset
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.datasets.png import write_png
    from econgs_bench.datasets.render_views import announce_slow, cameras_of, views_of

    step(f"reading {dataset_name}")
    dataset = open_dataset(dataset_name)
    if dataset.kind == "volume" and (options.truth or not options.model):
        announce_slow()
    count = options.views or 8
    samples = None if options.samples is None else samples_of(options.samples, "--samples")
    model, default = _model(options) if options.model else (None, ())
    names = options.scene or default or [scene.name for scene in dataset.scenes]
    parts = {name: [scene.name for scene in dataset.parts(name)] for name in names}
    edits = given_edits(options.edit)
    for scene in edits:
        if not any(scene in part for part in parts.values()):
            raise unknown("edited scene", scene, [scene for part in parts.values() for scene in part])
    for name, scenes in parts.items():
        if model is not None and (absent := [scene for scene in scenes if scene not in model.scenes]):
            raise DataError(
                options.model, f"has no scene {', '.join(absent)}", f"It holds {', '.join(model.scenes)}"
            )
        edit = {scene: edits[scene] for scene in scenes if scene in edits}
        if options.size:
            width, height = options.size
            rays = 1 if dataset.kind == "views" else dataset.samples if samples is None else samples
            views = Request(train_views=12, test_views=count, width=width, height=height, samples=rays)
        else:
            views = inputs.request(dataset, scenes[0], ViewPreset(12, count, 256, 256, sys.maxsize), samples)
        request = view_request(views, "test")
        folder = Path(options.out) / dataset.name / name
        doing = f"drawing {dataset.name}/{name}"
        step(doing)
        drawn = partial(step, doing)
        truth = None
        psnr: list[float] = []
        with _replacing(folder) as aside:
            if options.truth or model is None:
                truth = views_of(dataset, name, request, edit=edit, progress=drawn)
            if truth is not None:
                beside = aside if model is None else aside / "truth"
                beside.mkdir(exist_ok=True)
                for index, image in enumerate(truth.images):
                    write_png(beside / f"{index:04d}.png", image)
            if model is not None:
                background = dataset.parts(name)[0].background
                cameras = cameras_of(dataset, name, request)
                step(f"drawing {name} of {options.model}", 0, count)
                for index, (rgb, alpha) in enumerate(pictures(model, cameras, scenes, edit, background)):
                    step(f"drawing {name} of {options.model}", index + 1, count)
                    shown = rgb if alpha is None else premultiplied(rgb, alpha, background)
                    write_png(aside / f"{index:04d}.png", shown)
                    if truth is not None:
                        values, _ = evaluate(truth.images[index], rgb, alpha, background, ["psnr"])
                        psnr.append(float(values["psnr"] or 0.0))
        if psnr:
            low, mean, high = min(psnr), sum(psnr) / len(psnr), max(psnr)
            print(f"PSNR {mean:.2f} dB ({low:.2f} to {high:.2f}) against {folder / 'truth'}")
            if others := _unlike(options, dataset, scenes):
                print(f"This truth is not what the model learned as {', '.join(others)}.")
        print(folder)


def _unlike(options: Namespace, dataset: Dataset, scenes: Sequence[str]) -> list[str]:
    """Basic scenes whose definition or data are not those that a model learned."""
    from econgs_bench.bench.store.lineage import Lineage
    from econgs_bench.datasets.content import fingerprint

    lineage = Lineage(Store(Path(options.runs)).records())
    learned = lineage.contents(lineage.by_id[options.model]) or {}
    return [name for name in scenes if name in learned and fingerprint(dataset, name) != learned[name]]


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """A new folder for pictures, which take the place of those in ``folder`` when all are drawn.

    Files of other names stay, and everything where drawing fails: two calls never mix.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with aside_of(folder) as aside:
        aside.mkdir()
        yield aside
        for place in (folder, folder / "truth"):
            for old in place.glob("*.png"):
                if _NUMBERED.fullmatch(old.name):
                    old.unlink()
        for new in sorted(aside.rglob("*.png")):
            target = folder / new.relative_to(aside)
            target.parent.mkdir(parents=True, exist_ok=True)
            new.replace(target)


def _model(options: Namespace) -> tuple[Model, tuple[str, ...]]:
    """The model of a finished encode or measure job, and the scenes or the composition of that job."""
    step(f"loading {options.model}")
    store = Store(Path(options.runs))
    folders = plugin_folders(options.plugins, store.root)
    _, scenes, _, model = load(store, options.model, folders, options.device)
    record = store.record(options.model)
    composition = record.job.composition if record is not None else ""
    return model, (composition,) if composition else scenes


def score_arguments(parser: ArgumentParser) -> None:
    """What ``bench score`` takes."""
    parser.add_argument("renders", metavar="RENDERS")
    parser.add_argument("truth", metavar="TRUTH")
    parser.add_argument("--format", choices=FORMATS, default="csv")
    parser.add_argument(
        "--background",
        default="#ffffff",
        metavar="#RRGGBB",
        help="under alpha (default: #ffffff)",
    )


def score(options: Namespace) -> int:
    """Apply the metrics to two folders of images with the same names."""
    from econgs_bench.bench.commands.results import print_as
    from econgs_bench.bench.metrics.folders import score as score_folders

    try:
        background = hex_color(options.background)
    except ValueError as error:
        raise DataError("--background", str(error), "Example: --background #000000") from error
    step("scoring")
    print_as(score_folders(Path(options.renders), Path(options.truth), background), options.format)
    return 0
