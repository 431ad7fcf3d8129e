"""``bench export``: a finished model of Gaussians as a file that viewers of splats, or browsers, open."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.bench.commands.arguments import add_device, add_runs, add_stored, iterations
from econgs_bench.bench.run.plugins import plugin_folders
from econgs_bench.bench.saved import bytes_of, load, picture, seen
from econgs_bench.bench.store.store import Store, aside_of, write_text
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.reports.progress import step

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.scene import RGB
    from econgs_bench.datasets.views import Split, ViewSet
    from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
    from econgs_bench.methods.interface import Model

FORMATS = ("ply", "spz", "sog", "glb", "html")
SIZES = (1, 2, 4)
"""Multiples of the size of test views at which pictures are compared."""
_MEASURED, _ENLARGED = 8, 4
"""Views that are compared with the truth, and with the model's own pictures at all sizes."""


def export_arguments(parser: ArgumentParser) -> None:
    """What ``bench export`` takes."""
    add_stored(parser)
    add_runs(parser)
    parser.add_argument("model", metavar="JOB", help="an encode or measure job of --runs")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write")
    parser.add_argument("--format", choices=FORMATS, help="default: as the suffix of --out says")
    parser.add_argument("--scene", help="which, if the model holds several (default of html: all)")
    parser.add_argument(
        "--viewer", choices=("antialiased", "plain"),
        help="viewers that shrink opacities to compensate for their filter of 0.3 px², or that do not "
        "(default: antialiased; plain where the model is drawn so itself)",
    )  # fmt: skip
    parser.add_argument("--spz-version", type=int, choices=(3, 4), help="of the format spz (default: 3)")
    parser.add_argument(
        "--distil", type=iterations, default=1_000, metavar="N",
        help="iterations against the model's own pictures, where it has to be baked; 0: none (default: 1000)",
    )  # fmt: skip
    add_device(parser)


def export(options: Namespace) -> int:
    """Write the file, and say what it costs in views of the run store."""
    from econgs_bench.methods.baking.bake import VIEWERS

    name = _format(options)
    target = _target(options.out, name)
    if name == "html":
        return _page(target, options)
    store = Store(Path(options.runs))
    folders = plugin_folders(options.plugins, store.root)
    step(f"loading {options.model}")
    method, scenes, _, model = load(store, options.model, folders, options.device)
    scene = _scene(options, scenes, model)
    cameras, background, views, split = _seen(store, options.model, scene)
    viewer, stages = _plain(model, scene, cameras, background, options)
    gaussians = next(reversed(stages.values()))
    step(f"writing {options.out}")
    written = _written(target, name, gaussians, viewer, options.spz_version)
    rows = [(f"{method}, as it is", bytes_of(store, options.model, scene), model)]
    rows += [(title, one.rows().nbytes, _model(one)) for title, one in stages.items() if title]
    rows.append((options.out, written, _model(_read(target, name, gaussians))))
    print(
        f"PSNR [dB] in {len(views.cameras)} {split} views of {scene}: "
        f"against the truth in {viewer} viewers,\n"
        "and against the model's own pictures at several sizes in both kinds of viewers"
    )
    heads = "  ".join(
        f"{f'{name} {SIZES[0]}x':>15}{''.join(f'{one:>6}x' for one in SIZES[1:])}" for name in VIEWERS
    )
    print(f"{'truth':>7} {heads} {'bytes':>12} {'primitives':>11}")
    measured = _measured([model for *_, model in rows], scene, views, viewer)
    for (title, nbytes, one), (psnr, *others) in zip(rows, measured, strict=True):
        parts = [others[start : start + len(SIZES)] for start in range(0, len(others), len(SIZES))]
        numbers = "  ".join(
            f"{part[0]:15.2f}{''.join(f'{value:7.2f}' for value in part[1:])}" for part in parts
        )
        print(
            f"{psnr:7.2f} {numbers or ' ' * len(heads)} {nbytes:>12,} {one.primitives(scene):>11,}  {title}"
        )
    return 0


def _format(options: Namespace) -> str:
    """The format, by name or by the file's suffix."""
    name = str(options.format or Path(options.out).suffix.lstrip(".").lower())
    if name not in FORMATS:
        raise DataError(
            options.out, "its suffix names no format", f"Give --format, one of {', '.join(FORMATS)}"
        )
    if options.spz_version and name != "spz":
        raise DataError(
            options.out, f"--spz-version of the format {name}", "Leave it out, or give --format spz"
        )
    if options.viewer and name == "html":
        raise DataError(
            options.out, "--viewer of the format html, which draws as the model does", "Leave it out"
        )
    return name


def _target(out: str, name: str) -> Path:
    """The file to write, at the end of links; what cannot be written is refused before minutes of work.

    Raises:
        DataError: it is no regular file, its folder cannot be written to, or the format lacks a package.
    """
    from econgs_bench.methods.interface import Refused

    if out == "-":
        raise DataError(out, "names no file, and no format is printed", "Give --out FILE")
    try:
        target = Path(out).resolve()
        if target.is_dir():
            raise DataError(out, "is a folder", "Name a file in it")
        if target.exists() and not target.is_file():
            raise DataError(out, "is a device or a pipe, which would be replaced by a file", "Name a file")
        target.parent.mkdir(parents=True, exist_ok=True)
        with aside_of(target) as aside:
            _tried(aside, name)
    except Refused as error:
        raise DataError(out, str(error), "Install it, or choose another format") from error
    except (OSError, RuntimeError) as error:  # the latter is a circle of links, to Python before 3.13
        reason = getattr(error, "strerror", None) or error
        raise DataError(out, f"cannot be written ({reason})", "Name another file") from error
    return target


def _tried(aside: Path, name: str) -> None:
    """Write a scene without Gaussians, so that what a format needs is missed now; a page needs nothing."""
    import numpy as np

    from econgs_bench.methods.formats.gaussians import SHAPES, scene_of

    if name == "html":
        aside.touch()
        return
    none = {one: np.zeros((0, *shape), np.float32) for one, shape in SHAPES.items()}
    scene = scene_of(none, "", (0.0, 0.0, 0.0), 0)
    import_module(f"econgs_bench.methods.formats.{name}").write(aside, scene)


def _page(target: Path, options: Namespace) -> int:
    """Write a page for browsers, and say how near it comes to the model in views of the run store."""
    import numpy as np

    from econgs_bench.bench.jobs.measure import premultiplied
    from econgs_bench.bench.metrics import evaluate
    from econgs_bench.bench.view.beside import page_of
    from econgs_bench.bench.view.sources import of_job

    store = Store(Path(options.runs))
    step(f"loading {options.model}")
    opened = of_job(store, options.model, options.plugins, options.device)
    model = opened.model
    assert model is not None
    if options.scene and options.scene not in opened.scenes:
        raise unknown("scene", options.scene, opened.scenes, of="this model")
    scenes = (options.scene,) if options.scene else opened.scenes
    page = page_of(store, options.model, opened, scenes)
    step(f"writing {options.out}")
    write_text(target, page.text)
    means = []
    for scene in scenes:
        _, _, views, split = _seen(store, options.model, scene)
        rows: list[list[float]] = []
        for camera, image in zip(views.cameras, views.images, strict=True):
            step(f"measuring {scene}", len(rows), len(views.cameras))
            own, shown = (picture(one, camera, [scene], {}, views.background) for one in (model, page.model))
            pairs = ((image, own), (image, shown), (premultiplied(*own, views.background), shown))
            rows.append([
                float(evaluate(expected, *drawn, views.background, ["psnr"]).values["psnr"] or 0.0)
                for expected, drawn in pairs
            ])  # fmt: skip
        means.append(" ".join(f"{value:12.2f}" for value in np.mean(rows, axis=0)) + f"  {scene}")
    print(f"PSNR [dB] in up to {_MEASURED} {split} views; the page at 16 bits, drawn here")
    print(f"{'model, truth':>12} {'page, truth':>12} {'page, model':>12}", *means, sep="\n")
    size = target.stat().st_size
    times = f"{size / page.half:.2f} times the Gaussians at 16 bits ({page.half:,})"
    print(f"{options.out}: {size:,} bytes, {times}")
    return 0


def _scene(options: Namespace, scenes: Sequence[str], model: Model) -> str:
    """The scene to export: the one that is asked for, or the only one."""
    if options.scene:
        if options.scene not in model.scenes:
            raise unknown("scene", options.scene, model.scenes, of="this model")
        return str(options.scene)
    if len(scenes) != 1:
        raise DataError(options.model, f"holds {', '.join(scenes)}", "Choose one: --scene NAME")
    return scenes[0]


def _seen(store: Store, job: str, scene: str) -> tuple[Sequence[Camera], RGB, ViewSet, Split]:
    """Cameras that a job's fit saw of a scene, its background, the views that are measured, their split."""
    cameras, background, truth, split = seen(store, job, scene)
    count = len(truth.cameras(split))
    return cameras, background, truth.views(split, range(0, count, max(1, -(-count // _MEASURED)))), split


def _plain(
    model: Model, scene: str, cameras: Sequence[Camera], background: RGB, options: Namespace
) -> tuple[str, dict[str, SceneGaussians]]:
    """Name of the viewers, and plain Gaussians for them by how they were made, the last as they are written.

    Those of a model that is drawn so itself have no title.
    """
    from econgs_bench.methods.baking.bake import VIEWERS, baked, exact
    from econgs_bench.methods.baking.distil import distilled
    from econgs_bench.methods.formats.gaussians import drawable
    from econgs_bench.methods.interface import HasGaussians

    if not isinstance(model, HasGaussians):
        raise DataError(scene, "its model does not consist of Gaussians", "Export one of another method")
    for viewer in [options.viewer] if options.viewer else reversed(VIEWERS):
        own = exact(model, scene, VIEWERS[viewer])
        if own is not None:
            return viewer, {"": drawable(own)}
    step("baking to plain Gaussians")
    gaussians = drawable(baked(model, scene, cameras, background, VIEWERS[viewer]))
    stages = {"baked": gaussians}
    if options.distil:
        gaussians = distilled(
            gaussians, model, cameras, options.distil, VIEWERS[viewer],
            report=lambda done, _: step("distilling", done, options.distil),
        )  # fmt: skip
        stages[f"distilled, {options.distil} iterations"] = drawable(gaussians)
    return viewer, stages


def _written(target: Path, name: str, gaussians: SceneGaussians, viewer: str, spz_version: int | None) -> int:
    """Write the file whole, or not at all; its bytes."""
    more = {"version": spz_version} if spz_version else {}
    with aside_of(target) as aside:
        import_module(f"econgs_bench.methods.formats.{name}").write(
            aside, gaussians, antialiased=viewer == "antialiased", **more
        )
        aside.replace(target)
    return target.stat().st_size


def _read(file: Path, name: str, gaussians: SceneGaussians) -> SceneGaussians:
    """What the file holds; of glTF, which holds every number, the Gaussians that were written."""
    from econgs_bench.methods.formats.gaussians import scene_of

    if name == "glb":
        return gaussians
    contents = import_module(f"econgs_bench.methods.formats.{name}").read(file)
    return scene_of(contents.tables, gaussians.name, gaussians.background, gaussians.sh_degree)


def _model(gaussians: SceneGaussians) -> Model:
    from econgs_bench.methods.gaussian_splatting.model import GaussianModel

    return GaussianModel([gaussians])


def _measured(models: Sequence[Model], scene: str, views: ViewSet, viewer: str) -> list[list[float]]:
    """Mean PSNR of models: against the truth; of all but the first against its own pictures,
    by viewer and size.
    """
    import numpy as np

    from econgs_bench.bench.metrics import evaluate
    from econgs_bench.methods.baking.bake import VIEWERS, enlarged
    from econgs_bench.methods.shared.rendering import Rendering

    def psnr(model: Model, camera: Camera, image: NDArray[np.float32]) -> float:
        rgb, alpha = picture(model, camera, [scene], {}, views.background)
        values, _ = evaluate(image, rgb, alpha, views.background, ["psnr"])
        return float(values["psnr"] or 0.0)

    own, *others = models
    drawn = {
        name: [one.drawn_by(Rendering(low_pass=low_pass)) for one in others]  # type: ignore[attr-defined]
        for name, low_pass in VIEWERS.items()
    }
    count = len(views.cameras)
    rows = []
    for done, model in enumerate([own, *drawn[viewer]]):
        step("measuring against the truth", done, len(models))
        pairs = zip(views.cameras, views.images, strict=True)
        rows.append([sum(psnr(model, camera, image) for camera, image in pairs) / count])
    chosen = views.cameras[:: max(1, -(-count // _ENLARGED))]
    sums = np.zeros((len(others), len(VIEWERS), len(SIZES)))
    for size in range(len(SIZES)):
        for done, camera in enumerate(chosen):
            step(f"measuring at {SIZES[size]} times the size", done, len(chosen))
            larger = enlarged(camera, SIZES[size])
            image = np.dstack(picture(own, larger, [scene], {}, (0.0, 0.0, 0.0)))
            for kind, name in enumerate(VIEWERS):
                sums[:, kind, size] += [psnr(one, larger, image) for one in drawn[name]]
    return rows[:1] + [
        row + list(more.ravel() / len(chosen)) for row, more in zip(rows[1:], sums, strict=True)
    ]
