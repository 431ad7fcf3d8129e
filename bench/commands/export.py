"""``bench export``: a finished model of Gaussians as a file that viewers of splats open."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.bench.commands.arguments import add_device, add_runs, add_stored, iterations
from econgs_bench.bench.run.plugins import plugin_folders
from econgs_bench.bench.saved import load, picture, truth_of
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.views import Split, ViewSet
    from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
    from econgs_bench.methods.interface import Model

FORMATS = ("ply", "spz", "sog", "glb")
_MEASURED = 8
"""Test views on which the cost is measured."""


def export_arguments(parser: ArgumentParser) -> None:
    """What ``bench export`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument("model", metavar="JOB", help="an encode or measure job of --runs")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write")
    parser.add_argument(
        "--format", choices=("ply", "spz", "sog", "glb"), help="default: as the suffix of --out says"
    )
    parser.add_argument("--scene", help="which, if the model holds several")
    parser.add_argument(
        "--distil", type=iterations, default=1_000, metavar="N",
        help="iterations against the model's own pictures, where it has to be baked; 0: none (default: 1000)",
    )  # fmt: skip
    add_device(parser)


def export(options: Namespace) -> int:
    """Write the file, and say what it costs in the test views of the run store."""
    from econgs_bench.methods.gaussian_splatting.model import GaussianModel

    file, name = Path(options.out), _format(options)
    store = Store(Path(options.runs))
    folders = plugin_folders(options.plugins, store.root)
    step(f"loading {options.model}")
    method, scenes, size, model = load(store, options.model, folders, options.device)
    scene = _scene(options, scenes, model)
    record, truth = truth_of(store, options.model, scene)
    split: Split = "train" if record.job.split == "val" else "trainval"
    count = len(truth.cameras("test"))
    views = truth.views("test", range(0, count, max(1, -(-count // _MEASURED))))
    cameras = truth.cameras(split)
    step("measuring the model as it is")
    rows = [(f"{method}, as it is", size, model.primitives(scene), _psnr(model, scene, views))]

    def measure(title: str, gaussians: SceneGaussians) -> None:
        plain = GaussianModel([gaussians])
        rows.append((title, plain.bytes_estimate(), len(gaussians), _psnr(plain, scene, views)))

    gaussians = _plain(model, scene, cameras, views, options.distil, measure)
    step(f"writing {file}")
    size = _written(file, name, gaussians)
    step(f"measuring {file}")
    rows.append((str(file), size, len(gaussians), _psnr(_read(file, name, gaussians), scene, views)))
    print(f"PSNR in {len(views.cameras)} test views of {scene}; all but the first as plain viewers draw")
    for title, count, many, psnr in rows:
        print(f"{psnr:6.2f} dB  {count:>11,} bytes  {many:>9,} primitives  {title}")
    return 0


def _format(options: Namespace) -> str:
    """The format, by name or by the file's suffix."""
    name = str(options.format or Path(options.out).suffix.lstrip(".").lower())
    if name not in FORMATS:
        raise DataError(
            options.out, "its suffix names no format", f"Give --format, one of {', '.join(FORMATS)}"
        )
    return name


def _scene(options: Namespace, scenes: Sequence[str], model: Model) -> str:
    """The scene to export: the one that is asked for, or the only one."""
    if options.scene:
        if options.scene not in model.scenes:
            raise unknown("scene", options.scene, model.scenes, of="this model")
        return str(options.scene)
    if len(scenes) != 1:
        raise DataError(options.model, f"holds {', '.join(scenes)}", "Choose one: --scene NAME")
    return scenes[0]


def _plain(
    model: Model,
    scene: str,
    cameras: Sequence[Camera],
    views: ViewSet,
    iterations: int,
    measure: Callable[[str, SceneGaussians], None],
) -> SceneGaussians:
    """Plain Gaussians: the model's own, or baked and distilled ones."""
    from econgs_bench.methods.baking.bake import baked, exact
    from econgs_bench.methods.baking.distil import distilled
    from econgs_bench.methods.formats.gaussians import drawable
    from econgs_bench.methods.interface import HasGaussians

    if not isinstance(model, HasGaussians):
        raise DataError(scene, "its model does not consist of Gaussians", "Export one of another method")
    own = exact(model, scene)
    if own is not None:
        return drawable(own)
    step("baking to plain Gaussians")
    gaussians = baked(model, scene, cameras, views.background)
    measure("baked", gaussians)
    if iterations:
        gaussians = distilled(
            gaussians, model, cameras, iterations,
            report=lambda done, _: step("distilling", done, iterations),
        )  # fmt: skip
        step("measuring distilled Gaussians")
        measure(f"distilled, {iterations} iterations", gaussians)
    return drawable(gaussians)


def _written(file: Path, name: str, gaussians: SceneGaussians) -> int:
    """Write the file whole, or not at all; its bytes."""
    from econgs_bench.methods.interface import Refused

    module = import_module(f"econgs_bench.methods.formats.{name}")
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    try:
        module.write(part, gaussians)
        part.replace(file)
    except Refused as error:
        raise DataError(file, str(error), "Install it, or choose another format") from error
    finally:
        part.unlink(missing_ok=True)
    return file.stat().st_size


def _read(file: Path, name: str, gaussians: SceneGaussians) -> Model:
    """The model that the file holds; of glTF, which holds every number, the Gaussians that were written."""
    from econgs_bench.methods.formats.gaussians import scene_of
    from econgs_bench.methods.gaussian_splatting.model import GaussianModel

    if name != "glb":
        values = import_module(f"econgs_bench.methods.formats.{name}").read(file)
        gaussians = scene_of(values, gaussians.name, gaussians.background, gaussians.sh_degree)
    return GaussianModel([gaussians])


def _psnr(model: Model, scene: str, views: ViewSet) -> float:
    """Mean PSNR of views."""
    from econgs_bench.bench.metrics import evaluate

    total = 0.0
    for camera, image in zip(views.cameras, views.images, strict=True):
        rgb, alpha = picture(model, camera, [scene], {}, views.background)
        values, _ = evaluate(image, rgb, alpha, views.background, ["psnr"])
        total += float(values["psnr"] or 0.0)
    return total / len(views.cameras)
