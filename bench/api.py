"""The harness from Python; :mod:`.bench` has all of these names, docs/guide/python.ipynb shows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from econgs_bench.datasets.catalogue import DatasetInfo, list_datasets
from econgs_bench.datasets.catalogue import open_dataset as _open
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.scene import RGB, Dataset
from econgs_bench.datasets.views import Split, ViewRequest, ViewSet

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from econgs_bench.datasets.camera import Camera
    from econgs_bench.methods.interface import Model
    from econgs_bench.reports.charts.chart import Chart
    from econgs_bench.reports.report import Report

__all__ = [
    "DataError", "Dataset", "DatasetInfo", "Drawing", "Edit", "Runs", "SavedModel", "ViewSet",
    "list_datasets", "open_dataset", "render_views", "run", "score_views",
]  # fmt: skip

_Path = str | PathLike[str]


def open_dataset(name: _Path) -> Dataset:
    """Open a dataset.

    Args:
        name: of the catalogue (``"vortices@64"``), or path of a volume, of a TOML file with scenes, or of a
            folder with pre-rendered views; ``PATH:variable=T,step=3`` chooses within a file.

    Raises:
        DataError: the data are missing or unusable; the message has the remedy.
    """
    return _open(str(name))


def render_views(
    dataset: Dataset,
    scene: str,
    *,
    count: int = 8,
    size: tuple[int, int] = (256, 256),
    split: Split = "test",
    edit: Mapping[str, Edit] | None = None,
    samples: int | Literal["auto"] = "auto",
) -> ViewSet:
    """Ground truth of a scene or composition, rendered or read; rendered views are cached.

    Args:
        dataset: as :func:`open_dataset` returns it.
        scene: name of a basic scene or a composition.
        count: number of views: on the test path, or of training cameras.
        size: width and height in pixels; pre-rendered views need a whole fraction of their own.
        split: "test", "train", "val" or "trainval".
        edit: basic scene -> change, whose ground truth this is.
        samples: rays a pixel of rendered views, a square; default: as many as each pixel needs.

    Returns:
        Cameras, and images (count, height, width, 4), float32 RGBA in [0, 1], premultiplied by alpha.

    Raises:
        DataError: no such scene, or the data cannot be read or rendered.
    """
    from econgs_bench.datasets.ground_truth.sampling import samples_of
    from econgs_bench.datasets.render_views import views_of

    rays = samples_of(samples, "render_views")
    return views_of(dataset, scene, ViewRequest(split, count, count, *size, samples=rays), edit=edit)


def score_views(truth: ViewSet, views: ViewSet) -> pd.DataFrame:
    """All metrics of rendered views, a row per view; a metric that cannot be computed has no column.

    Args:
        truth: the ground truth.
        views: the same cameras, as :meth:`SavedModel.render_views` returns them.

    Raises:
        ValueError: the sets have other numbers or sizes of views.
    """
    import pandas as pd

    from econgs_bench.bench.metrics import evaluate

    back = truth.background
    rows = [
        {"view": camera.name}
        | evaluate(image, views.composited(i, back), views.images[i, ..., 3], back).values
        for i, (camera, image) in enumerate(zip(views.cameras, truth.images, strict=True))
    ]
    return pd.DataFrame(rows).set_index("view").dropna(axis=1, how="all")


def run(
    suite: _Path = "quick",
    *,
    out: _Path = "runs",
    datasets: Sequence[_Path] = (),
    scenes: Sequence[str] = (),
    composed: bool = False,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    preset: Literal["", "quick", "standard", "paper"] = "",
    split: Literal["test", "val"] = "test",
    samples: int | Literal["", "auto"] = "",
    options: Mapping[str, Mapping[str, Any]] | None = None,
    device: str = "cpu",
    plugins: Sequence[_Path] = (),
    retry: bool | Literal["failed", "busy"] = False,
    executor: Literal["local", "dask"] = "local",
    scheduler: str = "",
    workers: int | None = None,
    quiet: bool = False,
) -> Runs:
    """Run the jobs of a suite that are not finished yet, as ``bench run`` does, and return the run store.

    A job that fails is a row of the results, with its reason.

    Args:
        suite: name or TOML file.
        out: folder of the run store.
        datasets: names or paths instead of the suite's.
        scenes: names of the only scenes, or of compositions with their scenes.
        composed: measure the compositions of the scenes too.
        methods: names instead of the suite's.
        seeds: seeds instead of the suite's.
        preset: instead of the suite's.
        split: "val" leaves every tenth training view out of the fit and measures on those.
        samples: rays a pixel of rendered views; "": the datasets' own.
        options: method -> option -> value, differing from the preset.
        device: "cpu", "cuda" or "cuda:N".
        plugins: folders with methods of your own; default: those of earlier runs of this store.
        retry: run failed jobs again; "busy": those whose FPS or training time was disturbed, fits with all
            that follows from them.
        executor: "dask" runs jobs beside each other on workers of Dask.
        scheduler: address of Dask's scheduler; default: one on this machine.
        workers: how many are started on this machine; default: 1.
        quiet: no progress on standard error.

    Raises:
        DataError: the request or its input cannot be used.
        KeyboardInterrupt: Ctrl-C ended the run; the same call resumes it.
    """
    from econgs_bench.bench.run.display import Silence, make_display
    from econgs_bench.bench.run.experiment import execute
    from econgs_bench.bench.run.request import RunRequest
    from econgs_bench.datasets.ground_truth.sampling import samples_of

    rays = None if samples == "" else samples_of(samples, "run")
    request = RunRequest.of(
        str(suite), out, plugins,
        datasets=tuple(map(str, datasets)), scenes=tuple(scenes), composed=composed, methods=tuple(methods),
        seeds=tuple(seeds), preset=preset, split=split, samples=rays,
        overrides=options or {}, device=device, retry=retry, executor=executor, scheduler=scheduler,
        workers=workers,
    )  # fmt: skip
    done = execute(request, Silence() if quiet else make_display())
    if done.outcome.stopped:
        raise KeyboardInterrupt("the run was stopped; the same call resumes it")
    return Runs(done.store.root, plugins=done.plugins)


@dataclass(frozen=True)
class Drawing:
    """A chart of a report; a notebook shows it.

    Attributes:
        name: of its file in a report's folder ``charts``.
    """

    name: str
    _chart: Chart = field(repr=False)

    @property
    def svg(self) -> str:
        """The SVG document."""
        from econgs_bench.reports.charts import svg

        return svg.file(self._chart)

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: _Path) -> None:
        """Write the chart.

        Args:
            path: a file that ends in .svg, .pdf or .png.

        Raises:
            DataError: another ending.
        """
        import vl_convert

        from econgs_bench.reports.charts.files import pdf

        path = Path(path)
        writers: dict[str, Callable[[str], bytes]] = {
            ".svg": str.encode, ".pdf": pdf, ".png": lambda text: bytes(vl_convert.svg_to_png(text, scale=2)),
        }  # fmt: skip
        if path.suffix not in writers:
            raise DataError(path, "charts are SVG, PDF or PNG", "Name a file that ends in .svg, .pdf or .png")
        path.write_bytes(writers[path.suffix](self.svg))


class Runs:
    """A run store: what was measured, as tables, answers, charts and models.

    Tables are read once; open the store anew to see later jobs.

    Args:
        path: the folder that ``bench run --out`` or :func:`run` wrote.
        plugins: folders with methods of your own; default: those of its runs.

    Attributes:
        path: the folder.

    Raises:
        DataError: the folder is no run store.
    """

    def __init__(self, path: _Path = "runs", *, plugins: Sequence[_Path] = ()) -> None:
        from econgs_bench.bench.run.plugins import plugin_folders
        from econgs_bench.bench.store.store import Store

        self._store = Store(Path(path))
        self._plugins = plugin_folders(map(str, plugins), self._store.root)
        self.path = self._store.root

    def __repr__(self) -> str:
        return f"Runs({str(self.path)!r})"

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables of docs/reference/tables.md by name."""
        from econgs_bench.bench.results.tables import build_tables
        from econgs_bench.methods.registry import Registry

        return build_tables(self._store, Registry(self._plugins).specs, write=False)

    @property
    def results(self) -> pd.DataFrame:
        """A row per method, scene, seed and rate: quality, size, times, memory, and the job."""
        return self.tables["results"]

    @property
    def answers(self) -> dict[str, str]:
        """Criterion ("Smallest", "Best picture", ...) -> which method, by how much, and how significantly.

        It is empty where no two methods can be compared.
        """
        from econgs_bench.reports.sections.order import answers

        return {answer.title: answer.sentence for answer in answers(self._report)}

    @property
    def remarks(self) -> list[str]:
        """What is not compared in answers, means and charts, and why; `tables["differences"]` lists it."""
        from econgs_bench.reports.comparability import sentences

        return sentences(self._report.remarks)

    @cached_property
    def _report(self) -> Report:
        from econgs_bench.reports.report import Report

        return Report(self.tables)

    @cached_property
    def charts(self) -> dict[str, Drawing]:
        """The charts of the report by name: "psnr-size", "rate-distortion", "anytime-psnr" and more."""
        from econgs_bench.reports.sections.order import charts

        return {name: Drawing(name, chart) for name, chart in charts(self._report)}

    def report(self, page: _Path | None = None) -> Path:
        """Write the HTML report and its files, as ``bench report`` does.

        Args:
            page: the HTML file; default: ``report.html`` in the run store.

        Returns:
            The page.
        """
        from econgs_bench.reports.page.document import write_report

        path = self.path / "report.html" if page is None else Path(page)
        path.parent.mkdir(parents=True, exist_ok=True)
        return write_report(self.tables, self.path, path, report=self._report)

    def model(self, job: str, device: str = "cpu") -> SavedModel:
        """The model of a job, loaded from its files.

        Args:
            job: as in the column ``job`` of :attr:`results`.
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            DataError: there is no finished job of that name with a model, or it cannot be rendered here.
        """
        from econgs_bench.bench.saved import load

        return SavedModel(*load(self._store, job, self._plugins, device))


@dataclass(frozen=True)
class SavedModel:
    """A model from its files.

    Attributes:
        method: name of the method.
        scenes: basic scenes of its job, which are rendered together by default.
        size_bytes: of its files, which may hold further scenes.
    """

    method: str
    scenes: tuple[str, ...]
    size_bytes: int
    _model: Model = field(repr=False)

    @property
    def all_scenes(self) -> tuple[str, ...]:
        """Basic scenes that the files hold."""
        return tuple(self._model.scenes)

    def primitives(self, scene: str | None = None) -> int:
        """Number of primitives of a scene, or of all."""
        return self._model.primitives(scene)

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        *,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> NDArray[np.float32]:
        """One picture.

        Args:
            camera: the view, for example of a :class:`ViewSet`.
            scenes: names; default: :attr:`scenes`.
            edit: scene -> change of palette, opacity or light.
            background: RGB in [0, 1]; default: that of the first scene.

        Returns:
            (height, width, 3) RGB in [0, 1] as displayed.

        Raises:
            DataError: the model lacks a scene, or its method cannot make the edit or composition.
        """
        return self._render(camera, scenes, edit, background)[0]

    def render_views(
        self,
        truth: ViewSet,
        scenes: Sequence[str] | None = None,
        *,
        edit: Mapping[str, Edit] | None = None,
    ) -> ViewSet:
        """The model in the views of a ground truth, on its background; arguments as :meth:`render`.

        Returns:
            The same cameras with images (count, height, width, 4) of the model, premultiplied by alpha.
        """
        import numpy as np

        from econgs_bench.bench.jobs.measure import premultiplied

        back = truth.background
        pictures = [
            premultiplied(*self._render(camera, scenes, edit, back), back) for camera in truth.cameras
        ]
        return ViewSet(truth.cameras, np.stack(pictures), back, f"{self.method} {truth.key}")

    def _render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None,
        edit: Mapping[str, Edit] | None,
        background: RGB | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        from econgs_bench.bench.saved import picture

        names = list(self.scenes if scenes is None else scenes)
        for name in names:
            if name not in self._model.scenes:
                raise unknown("scene", name, self._model.scenes, of=f"this model of {self.method}")
        return picture(self._model, camera, names, edit or {}, background)
