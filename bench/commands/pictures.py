"""``bench render`` and ``bench score``: pictures to look at, and the metrics on any two folders of them."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from bench.records import Record
from bench.store import Store
from datasets.errors import DataError


def render(options: Namespace) -> int:
    """Write views on the test path as PNG files: of the ground truth, or of a finished model."""
    if options.contact_sheet:
        from bench.commands.sheets import contact_sheets

        return contact_sheets(options)
    if options.automatic:
        raise DataError("--automatic", "is for contact sheets", "Add --contact-sheet")
    if not options.dataset:
        raise DataError("bench render", "names no dataset", "Name one of `bench list datasets`, or a path")
    for name in options.dataset:
        _render(options, name)
    return 0


def _render(options: Namespace, dataset_name: str) -> None:
    from bench.inputs import open_dataset, views
    from bench.measure import premultiplied
    from bench.monitor import as_numpy
    from bench.records import Request
    from datasets.png import write_png

    dataset = open_dataset(dataset_name)
    count, (width, height) = options.views or 8, options.size or (256, 256)
    wanted = Request(train_views=12, test_views=count, width=width, height=height)
    model, held = _model(options) if options.model else (None, ())
    for name in options.scene or held or [scene.name for scene in dataset.scenes]:
        scene = dataset.scene(name)
        if held and name not in held:
            raise DataError(options.model, f"has no scene {name!r}", f"It holds {', '.join(held)}")
        truth = views(dataset, scene.name, wanted, "test")
        folder = Path(options.out) / dataset.name / name
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(min(count, len(truth))):
            image = truth.images[index]
            if model is not None:
                rgb, alpha = model.render(truth.cameras[index], scenes=[name], background=truth.background)
                image = premultiplied(as_numpy(rgb), as_numpy(alpha), truth.background)
            write_png(folder / f"{index:04d}.png", image)
        print(folder)


def _model(options: Namespace):  # type: ignore[no-untyped-def]
    """The model of a finished encode or measure job, and its scenes."""
    from bench.worker import prepare_device
    from methods.interface import Refused
    from methods.registry import Registry, load_method

    store = Store(Path(options.runs))
    record = store.record(options.model)
    if record is not None and record.job.kind == "measure":
        record = _encode_of(store, record)
    if record is None or record.job.kind != "encode" or not record.ok:
        raise DataError(
            options.model,
            f"is no finished encode or measure job of {store.root}",
            "`bench results` names the jobs in its column `job`",
        )
    spec = Registry(options.plugins).spec(str(record.job.method))
    try:
        prepare_device(options.device, spec)
    except Refused as error:
        raise DataError(f"--device {options.device}", str(error), "Render on another device") from error
    model = load_method(spec).load(store.jobs / record.job.id / "model", options.device)
    return model, tuple(record.job.scenes)


def _encode_of(store: Store, record: Record) -> Record | None:
    return next((store.record(need) for need in record.job.needs if need.startswith("encode-")), None)


def score(options: Namespace) -> int:
    """Apply the metrics to two folders of images with the same names."""
    from bench.commands.results import print_as
    from bench.metrics.folders import score as score_folders

    print_as(score_folders(Path(options.renders), Path(options.truth)), options.format)
    return 0
