"""What is looked at: trained models, exported files, and the ground truth of scenes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera, looked_at
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB, WHITE, BasicScene, Dataset

if TYPE_CHECKING:
    from econgs_bench.bench.jobs.truth import Truth
    from econgs_bench.bench.store.store import Store
    from econgs_bench.datasets.catalogue.editing import Editable
    from econgs_bench.datasets.edits import Edit
    from econgs_bench.datasets.views import Split
    from econgs_bench.econgs.splat.splats import Splats
    from econgs_bench.methods.interface import Model

Picture = NDArray[np.float32]
"""(height, width, 4) premultiplied RGBA in [0, 1], without a background."""
Edits = Mapping[str, "Edit"]
_VIEWS = 16  # bookmarks of a source that no test views belong to
_SIZE = 256
_PREPARED = 4  # scenes whose tracing is set up


# --------------------------------------------------------------------------- ground truth


class Drawer(Protocol):
    """Draws the ground truth of scenes together."""

    def draw(self, camera: Camera, scenes: Sequence[str], edits: Edits, samples: int | None) -> Picture:
        """One view; ``samples`` rays a pixel, by default as many as the dataset asks for.

        Raises:
            DataError: the volume is gone, or the scenes or the edit cannot be drawn.
        """


class Marched:
    """Ground truth at any camera, marched through the volume.

    One thread does all of it: Mitsuba belongs to the thread that started it, and one picture at a time is
    what two cores can draw.

    Args:
        dataset: with volumes; None: ``name`` is opened when the first picture is asked for.
        name: in the catalogue, or a path.
        samples: rays a pixel at rest.
        learned: name -> definition and content hash ("": not known) of the scenes that a model learned. They
            are drawn as they were then, or refused where their data are others now.
    """

    def __init__(
        self,
        name: str,
        dataset: Dataset | None = None,
        samples: int = 0,
        learned: Mapping[str, tuple[BasicScene, str]] = MappingProxyType({}),
    ) -> None:
        self._name, self._dataset, self._samples, self._learned = name, dataset, samples, learned
        self._thread = ThreadPoolExecutor(1, "truth")
        self._prepared: dict[Any, Any] = {}
        self._definitions: dict[str, BasicScene] = {}

    def draw(self, camera: Camera, scenes: Sequence[str], edits: Edits, samples: int | None) -> Picture:
        """One view; see :class:`Drawer`."""
        return self._thread.submit(self._draw, camera, tuple(scenes), edits, samples).result()

    def defined(self, definitions: Sequence[BasicScene]) -> Marched:
        """The same volumes with other scenes."""
        other = copy(self)
        other._definitions = {scene.name: scene for scene in definitions}
        return other

    def _draw(self, camera: Camera, scenes: tuple[str, ...], edits: Edits, samples: int | None) -> Picture:
        rays = self._samples if samples is None else samples
        key = scenes, repr(sorted(edits.items())), rays, tuple(self._definitions.get(one) for one in scenes)
        if key not in self._prepared:
            while len(self._prepared) >= _PREPARED:
                del self._prepared[next(iter(self._prepared))]
            self._prepared[key] = self._prepare(scenes, edits, rays)
        return np.asarray(self._prepared[key]((camera,))[0])

    def _prepare(self, scenes: tuple[str, ...], edits: Edits, rays: int) -> Any:
        from econgs_bench.datasets.edits import edited
        from econgs_bench.datasets.render_views import RenderJob
        from econgs_bench.datasets.views import ViewRequest

        if self._dataset is None:
            self._dataset = self._open()
        parts = tuple(self._definitions.get(name) or self._dataset.scene(name) for name in scenes)
        parts = tuple(edited(one, edits[one.name]) if one.name in edits else one for one in parts)
        request = ViewRequest("test", 12, 1, 8, 8, samples=rays)
        return RenderJob.of(self._dataset, parts, request, "auto").set_up()[0]

    def _open(self) -> Dataset:
        from econgs_bench.datasets.catalogue import open_dataset
        from econgs_bench.datasets.content import fingerprint

        dataset = open_dataset(self._name)
        known = {name: scene for name, (scene, _) in self._learned.items()}
        scenes = [known.pop(one.name, one) for one in dataset.scenes]
        dataset = replace(dataset, scenes=(*scenes, *known.values()))
        for name, (_, content) in self._learned.items():
            if content and fingerprint(dataset, name) != content:
                reason = f"has not the data any more that the model learned as {name}"
                raise DataError(self._name, reason, "Restore its files, or train again")
        return dataset


class Stored:
    """Ground truth at the test views of a store alone, of a scene that was rendered elsewhere.

    Args:
        scene: its name.
        truth: what its views job stored.
        split: that was measured on.
    """

    def __init__(self, scene: str, truth: Truth, split: Split) -> None:
        self._scene, self._truth, self._split, self._cameras = scene, truth, split, truth.cameras(split)

    def draw(self, camera: Camera, scenes: Sequence[str], edits: Edits, samples: int | None) -> Picture:
        """A test view in its own size; see :class:`Drawer`."""
        near = [np.abs(one.camera_to_world - camera.camera_to_world).max() for one in self._cameras]
        place = int(np.argmin(near))
        if near[place] > 1e-6 or edits or list(scenes) != [self._scene]:
            reason = "was rendered elsewhere: its truth is known at its test views alone, one scene, unedited"
            raise DataError(self._scene, reason, "Choose a bookmark")
        if not _same_lens(camera, self._cameras[place]):
            reason = "was rendered elsewhere, in another shape of picture"
            raise DataError(self._scene, reason, "Choose a size in pixels, not the window's")
        return np.asarray(self._truth.views(self._split, [place]).images[0])


def _same_lens(one: Camera, other: Camera) -> bool:
    """Whether two cameras of one pose show the same in any size, within a pixel of the first."""
    own = other.resized(one.width, one.height)
    side = min(one.width, one.height)
    focal = max(abs(one.fx - own.fx) / own.fx, abs(one.fy - own.fy) / own.fy)
    return focal * side <= 1.0 and max(abs(one.cx - own.cx), abs(one.cy - own.cy)) <= 1.0


# --------------------------------------------------------------------------- sources


@dataclass(eq=False)
class Opened:
    """A source that is ready to be drawn.

    Attributes:
        scenes: names, of which any subset may be shown.
        background: as recorded.
        cameras: bookmarks, at least one.
        model: None: the truth itself.
        drawer: of its ground truth; None: not at hand.
        definitions: basic scenes by name, as far as they are known.
        edits: parts of :class:`.datasets.edits.Edit` that the model honours.
        shown: the scenes that are shown at first; empty: the first one.
        size: bytes of the files; None of the truth.
        seconds: time to load.
        editable: its scenes, whose transfer functions can be edited; None: they cannot.
        viewer: the kind of viewers that an exported file is for, as it is drawn; "" of all else.
    """

    scenes: tuple[str, ...]
    background: RGB
    cameras: tuple[Camera, ...]
    model: Model | None = None
    drawer: Drawer | None = None
    definitions: Mapping[str, BasicScene] = field(default_factory=dict)
    edits: frozenset[str] = frozenset()
    shown: tuple[str, ...] = ()
    size: int | None = None
    seconds: float = 0.0
    editable: Editable | None = None
    viewer: str = ""

    def defined(self, tables: Any) -> Opened:
        """The same with the scenes of tables (:class:`.datasets.catalogue.editing.Editable`).

        Raises:
            DataError: its scenes cannot be edited, or the tables are refused.
        """
        if self.editable is None or not isinstance(self.drawer, Marched):
            raise DataError("this source", "has no transfer functions to edit", "View a volume or a dataset")
        scenes = self.editable.scenes(tables)
        definitions = {scene.name: scene for scene in scenes}
        drawer = self.drawer.defined(scenes)
        return replace(self, scenes=tuple(definitions), definitions=definitions, drawer=drawer)

    def about(self) -> dict[str, Any]:
        """What the page shows of it, as JSON values."""
        from econgs_bench.datasets.edits import mean_color
        from econgs_bench.methods.interface import Splatted

        centre = looked_at(self.cameras)
        scenes = []
        for name in self.scenes:
            scene = self.definitions.get(name)
            known = scene is not None and scene.views_folder is None
            light = None if scene is None or scene.light is None else scene.light.direction
            scenes.append({
                "name": name,
                "color": mean_color(scene) if known and scene is not None else None,
                "light": light,
                "primitives": None if self.model is None else self.model.primitives(name),
            })  # fmt: skip
        return {
            "scenes": scenes,
            "background": self.background,
            "cameras": [camera_json(camera) for camera in self.cameras],
            "centre": centre.tolist(),
            "splats": isinstance(self.model, Splatted),
            "truth": self.drawer is not None,
            "model": self.model is not None,
            "edits": sorted(self.edits),
            "shown": self.shown or self.scenes[:1],
            "bytes": self.size,
            "viewer": self.viewer,
            "seconds": self.seconds,
            "tables": None if self.editable is None else self.editable.tables,
            "variables": [] if self.editable is None else list(self.editable.dataset.volumes),
        }

    def splats(self, camera: Camera, scenes: Sequence[str], edits: Edits) -> Splats:
        """What is splatted, in scene units; the variance in the scene is part of the scales.

        Raises:
            DataError: the source does not consist of Gaussians, or refuses the scenes or the edit.
        """
        import math

        import torch

        from econgs_bench.methods.interface import Refused, Splatted

        if not isinstance(self.model, Splatted):
            raise DataError("this model", "does not consist of Gaussians", "Ask for its picture")
        try:
            own = self.model.splatted(camera, scenes, edits)
        except Refused as error:
            raise DataError("this picture", str(error), "Leave out what this method refuses") from error
        # The camera came back in the model's own units.
        units = camera.near / own.camera.near
        scales, smoothing = own.scales, own.low_pass.smoothing
        if smoothing:
            scales = torch.hypot(scales, scales.new_tensor(math.sqrt(smoothing)))
        low_pass = replace(own.low_pass, smoothing=0.0)
        return own._replace(means=own.means * units, scales=scales * units, camera=camera, low_pass=low_pass)

    def picture(
        self, camera: Camera, scenes: Sequence[str], edits: Edits, background: RGB, samples: int | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """A view, drawn here: by the model, or the truth where there is none.

        Args:
            camera: the view.
            scenes: shown together, at least one.
            edits: by scene.
            background: on which it is composited.
            samples: rays a pixel of the truth; None: as many as the dataset asks for.

        Returns:
            RGB (height, width, 3) and alpha (height, width).

        Raises:
            DataError: the scenes or the edit are refused, or the volume is gone.
        """
        from econgs_bench.bench.saved import picture
        from econgs_bench.datasets.views import over

        if self.model is not None:
            return picture(self.model, camera, list(scenes), edits, background)
        truth = self.truth(camera, scenes, edits, samples)
        return over(truth, background), truth[..., 3]

    def truth(self, camera: Camera, scenes: Sequence[str], edits: Edits, samples: int | None) -> Picture:
        """The ground truth of a view, without a background; arguments as of :meth:`picture`."""
        if self.drawer is None:
            reason, remedy = "its ground truth is not at hand", "View a model of a run store, or a dataset"
            raise DataError("this file", reason, remedy)
        return self.drawer.draw(camera, scenes, edits, samples)


class Source:
    """Something to look at, opened when it is first asked for.

    Args:
        label: for people.
        opener: opens it, or raises ``DataError``.
    """

    def __init__(self, label: str, opener: Callable[[], Opened]) -> None:
        self.label = label
        self._opener, self._lock, self._opened = opener, Lock(), None

    _opened: Opened | None

    def open(self) -> Opened:
        """It, ready to be drawn.

        Raises:
            DataError: it is damaged, gone, or cannot be looked at.
        """
        with self._lock:
            if self._opened is None:
                start = time.perf_counter()
                self._opened = self._opener()
                self._opened.seconds = time.perf_counter() - start
            return self._opened


def camera_json(camera: Camera) -> dict[str, Any]:
    """A camera as JSON values."""
    return {
        "matrix": camera.camera_to_world.ravel().tolist(),
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height, "near": camera.near, "name": camera.name,
    }  # fmt: skip


# --------------------------------------------------------------------------- what a command line names


def found(names: Sequence[str], runs: Path, plugins: Sequence[str], device: str) -> list[Source]:
    """The sources that words name: jobs, folders of stores and models, exported files, datasets.

    Args:
        names: none: every model of the run store.
        runs: the run store of jobs that are named.
        plugins: folders of methods, of the command line.
        device: of the models.

    Raises:
        DataError: a word names nothing that can be looked at.
    """
    sources: list[Source] = []
    for name in names or [str(runs)]:
        one = _named(name, runs, plugins, device)
        if len(one) == 1:
            one[0].open()  # what cannot be used is refused before a page opens
        sources += one
    return sources


def _named(name: str, runs: Path, plugins: Sequence[str], device: str) -> list[Source]:
    import re

    from econgs_bench.bench.store.records import KINDS
    from econgs_bench.bench.store.store import Store
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.methods.formats import READ, refuse_unread

    path = Path(name).expanduser()
    job = re.compile(f"({'|'.join(KINDS)})-[0-9a-f]{{16}}")
    if job.fullmatch(name) and not path.exists():
        return [_job(Store(runs), name, plugins, device)]
    if path.is_dir():
        path = path.resolve()
        if (path / "store.json").is_file():
            return _models(Store(path), plugins, device)
        for folder in (path, path.parent):  # of a job, or the model in it
            if job.fullmatch(folder.name) and (folder.parents[1] / "store.json").is_file():
                return [_job(Store(folder.parents[1]), folder.name, plugins, device)]
        try:
            dataset = open_dataset(name)
        except DataError as error:
            otherwise = error if _holds_data(path) else None
            return [Source(path.name, lambda: _folder(path, plugins, device, otherwise))]
        return [_dataset(name, dataset)]
    elif path == runs:
        Store(runs)  # says what is wrong with it
    if path.suffix.lower() in READ and path.is_file():
        return [Source(path.name, lambda: _file(path))]
    refuse_unread(path)
    return [_dataset(name, open_dataset(name))]


def _holds_data(folder: Path) -> bool:
    """Whether a folder looks like a dataset, usable or not."""
    from econgs_bench.datasets.posed_images import holds_views
    from econgs_bench.datasets.readers import folder_kind

    try:
        return holds_views(folder) or bool(folder_kind(folder))
    except OSError:
        return False


def _models(store: Store, plugins: Sequence[str], device: str) -> list[Source]:
    """Every model of a run store whose files are here."""
    records = [
        record
        for record in store.records()
        if record.job.kind == "encode" and record.ok and store.holds_files_of(record)
    ]
    if not records:
        raise DataError(
            store.root, "holds no finished model", "Run a suite into it: bench run quick --out DIR"
        )
    return [_job(store, record.job.id, plugins, device) for record in records]


def _job(store: Store, job_id: str, plugins: Sequence[str], device: str) -> Source:
    return Source(title_of(store, job_id), lambda: of_job(store, job_id, plugins, device))


def title_of(store: Store, job_id: str) -> str:
    """What people call the model of a job."""
    record = store.record(job_id)
    return job_id if record is None else record.job.title.removeprefix(f"{record.job.kind} ")


def of_job(store: Store, job_id: str, plugins: Sequence[str], device: str) -> Opened:
    """The model of a finished encode or measure job, with its test views as bookmarks.

    Raises:
        DataError: there is no such job, or it cannot be loaded.
    """
    from econgs_bench.bench.run.plugins import plugin_folders
    from econgs_bench.bench.saved import load, measured_split, truth_of
    from econgs_bench.methods.registry import Registry

    loaded = store.record(job_id)
    folders = plugin_folders(plugins, store.root)
    method, scenes, size, model = load(store, job_id, folders, device)
    spec = Registry(folders).spec(method)
    names = [name for name in model.scenes if name in scenes] or list(model.scenes)
    stored = {name: truth_of(store, job_id, name) for name in names}
    record, truth = stored[names[0]]
    if record.job.stress:
        raise DataError(job_id, f"is a model under stress ({record.job.stress})", "View one without stress")
    definitions = {name: own.scene() for name, (_, own) in stored.items()}
    first = definitions[names[0]]
    drawer: Drawer
    if first.views_folder is None:
        learned = {
            name: (definitions[name], str(views.job.identity.get("scene", "")))
            for name, (views, _) in stored.items()
        }
        drawer = Marched(record.job.dataset, samples=record.job.request.samples, learned=learned)
    else:
        drawer = Stored(first.name, truth, measured_split(record.job))
    shown = scenes if loaded is not None and loaded.job.composition else ()
    cameras = truth.cameras(measured_split(record.job))
    return Opened(
        tuple(names), first.background, cameras, model, drawer, definitions,
        frozenset(spec.edits), shown, size,
    )  # fmt: skip


def _folder(folder: Path, plugins: Sequence[str], device: str, otherwise: DataError | None) -> Opened:
    """A saved model without its store: the method that reads it is the one that wrote it.

    Raises:
        DataError: a method knows its files and cannot read them; no method does: ``otherwise`` where given.
    """
    from econgs_bench.bench.store.store import folder_bytes
    from econgs_bench.methods.registry import Registry, load_method
    from econgs_bench.methods.shared.files import NotSaved

    registry = Registry(plugins)
    damaged = None
    for name in registry.names():
        spec = registry.spec(name)
        try:
            model = load_method(spec).load(folder, device)
        except Exception as error:  # each method refuses the files of the others in its own words
            if isinstance(error, DataError) and not isinstance(error, NotSaved):
                damaged = damaged or error
            continue
        cameras, size = _around(model, model.scenes), folder_bytes(folder)
        background = _recorded(model, cameras[0])
        return Opened(model.scenes, background, cameras, model, edits=frozenset(spec.edits), size=size)
    unknown = DataError(folder, "holds no model that a method reads, and no dataset", "Give a job")
    raise damaged or otherwise or unknown


def _recorded(model: Model, camera: Camera) -> RGB:
    """The background that a model recorded, from what shines through its picture."""
    from econgs_bench.bench.jobs.monitor import as_numpy
    from econgs_bench.methods.interface import DrawsTogether

    if isinstance(model, DrawsTogether):  # by a program of its own: slow
        return WHITE
    camera = camera.resized(32, 32)
    own, alpha = map(as_numpy, model.render(camera))
    black, _ = map(as_numpy, model.render(camera, background=(0.0, 0.0, 0.0)))
    at = np.unravel_index(int(alpha.argmin()), alpha.shape)
    if alpha[at] > 0.999:
        return WHITE
    red, green, blue = np.clip((own[at] - black[at]) / (1.0 - alpha[at]), 0.0, 1.0).round(4).tolist()
    return red, green, blue


def _file(file: Path) -> Opened:
    """An exported file, drawn by the viewers that it says it is for: plain ones where it says nothing."""
    from importlib import import_module

    from econgs_bench.methods.baking.bake import VIEWERS
    from econgs_bench.methods.formats.gaussians import scene_of
    from econgs_bench.methods.gaussian_splatting.model import GaussianModel
    from econgs_bench.methods.interface import Refused
    from econgs_bench.methods.shared.rendering import Rendering

    module = import_module(f"econgs_bench.methods.formats.{file.suffix.lower().lstrip('.')}")
    try:
        contents = module.read(file)
    except Refused as error:
        raise DataError(file, str(error), "Install it, or export another format") from error
    model = GaussianModel([scene_of(contents.tables, file.stem, WHITE, 3)])
    model = model.drawn_by(Rendering(low_pass=VIEWERS[contents.viewer]))
    cameras = _around(model, model.scenes)
    return Opened(
        model.scenes, WHITE, cameras, model, edits=frozenset({"opacity"}), size=file.stat().st_size,
        viewer=contents.viewer,
    )  # fmt: skip


def _around(model: Model, scenes: Sequence[str]) -> tuple[Camera, ...]:
    """Cameras around the middle of a model's Gaussians, or around scene space."""
    from econgs_bench.datasets.camera_paths import test_cameras
    from econgs_bench.methods.interface import Splatted

    centre, radius = np.zeros(3), 0.87
    cameras = test_cameras(_VIEWS, radius, _SIZE, _SIZE)
    if isinstance(model, Splatted) and (means := model.splatted(cameras[0], scenes).means.numpy()).size:
        centre = np.median(means, axis=0).astype(np.float64)
        radius = max(float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.98)), 1e-6)
    x, y, z = centre.tolist()
    return test_cameras(_VIEWS, radius, _SIZE, _SIZE, (x, y, z))


def _dataset(name: str, dataset: Dataset) -> Source:
    """The ground truth of a dataset."""
    from econgs_bench.datasets.render_views import cameras_of
    from econgs_bench.datasets.views import ViewRequest

    if dataset.kind == "views":
        raise DataError(name, "holds pictures, no volume", "View a model that was trained on it")

    def opened() -> Opened:
        from econgs_bench.datasets.catalogue.editing import Editable

        request = ViewRequest("test", 12, _VIEWS, _SIZE, _SIZE)
        scenes = tuple(scene.name for scene in dataset.scenes)
        cameras = cameras_of(dataset, scenes[0], request)
        definitions = {scene.name: scene for scene in dataset.scenes}
        drawer = Marched(name, dataset, dataset.samples)
        edits = {"palette", "opacity", "light", "shading", "transfer"}
        if any(scene.light is None for scene in dataset.scenes):
            edits -= {"light", "shading"}
        background = dataset.scenes[0].background
        return Opened(
            scenes, background, cameras, None, drawer, definitions, frozenset(edits),
            editable=Editable(name, dataset),
        )  # fmt: skip

    return Source(f"{dataset.name} (ground truth)", opened)
