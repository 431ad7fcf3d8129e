"""The ground-truth views of a scene: rendered, from the cache, or read where they were rendered elsewhere."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache as once
from functools import cached_property, lru_cache
from importlib.metadata import version
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import test_cameras, training_cameras
from econgs_bench.datasets.edits import Edit, edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.ground_truth.model import (
    MODEL_VERSION,
    Draw,
    Layer,
    Marcher,
    MarchSettings,
    Progress,
    same_grid,
)
from econgs_bench.datasets.ground_truth.sampling import ADAPTIVE, SAMPLING_VERSION, checked
from econgs_bench.datasets.memory import peak_drjit_device_bytes, peak_host_bytes
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.scene import RGB, BasicScene, Dataset, Frame
from econgs_bench.datasets.scratch import picked
from econgs_bench.datasets.view_cache import CachedViews, ViewCache
from econgs_bench.datasets.views import ViewRequest, ViewSet, evenly_spaced, split_indices
from econgs_bench.datasets.volume import Volume

Renderer = Literal["auto", "mitsuba", "reference"]

_log = logging.getLogger(__name__)
_digests: WeakKeyDictionary[Volume, str] = WeakKeyDictionary()


def views_of(
    dataset: Dataset,
    scene_name: str,
    request: ViewRequest,
    *,
    edit: Mapping[str, Edit] | None = None,
    background: RGB | None = None,
    renderer: Renderer = "auto",
    cache: ViewCache | None = None,
    progress: Progress | None = None,
) -> ViewSet:
    """The views of a request, of one basic scene or of a composition.

    All training views are rendered and cached together, whatever the split.

    Args:
        dataset: with volumes (views are rendered) or with views only (they are read).
        scene_name: one of its basic scenes or compositions.
        request: split, numbers and size.
        edit: basic scene -> changes (:func:`.datasets.edits.edited`); others stay as they are.
        background: recorded with the views; default: that of the (first) scene.
        renderer: "auto" takes Mitsuba where it works, else the reference marcher, with a notice.
        cache: default: that of the user.
        progress: called with the number of views rendered and of all views.

    Raises:
        UnknownName: no such scene, or an edit of a scene that the views do not show.
        DataError: the request cannot be met, or ``renderer`` is "mitsuba" and it cannot run.
    """
    parts = _edited(dataset.parts(scene_name), edit)
    background = parts[0].background if background is None else background
    if dataset.kind == "views":
        from econgs_bench.datasets.prerendered import load_views

        prerendered: ViewSet = load_views(parts[0], request)
        return replace(prerendered, background=background)
    cache = ViewCache() if cache is None else cache
    job = RenderJob.of(dataset, parts, request, renderer)
    views = cache.get(job.key)
    if views is None:
        images, record = job.render(progress)
        views = CachedViews(cache.put(job.key, images, record), record)
    if len(job.places) == len(job.cameras):
        return ViewSet(job.cameras, views.images, background, job.key, views.record)
    cameras = tuple(job.cameras[i] for i in job.places)
    key = f"{job.key}-{request.split}"
    return ViewSet(cameras, picked(views.images, job.places), background, key, views.record)


def cameras_of(dataset: Dataset, scene_name: str, request: ViewRequest) -> tuple[Camera, ...]:
    """The cameras of a request, without rendering or reading pictures."""
    parts = dataset.parts(scene_name)
    if dataset.kind == "views":
        from econgs_bench.datasets.prerendered import view_cameras

        return view_cameras(parts[0], request)
    cameras = _cameras(dataset.volume(parts[0].variable), dataset.frame, request)
    return tuple(cameras[i] for i in split_indices(len(cameras), request.split))


FLOOR_VIEWS = 2
"""Views in which the truth is compared with a finer one."""


@dataclass(frozen=True, eq=False)
class Finer:
    """Some views of a request, rendered once more with other rays.

    Attributes:
        places: positions of these views among those of the request.
        one_ray: (n, height, width, 4) the same with one ray a pixel, through its centre.
        finer: (n, height, width, 4) the same at twice the width and height, with as many rays as those pixels
            need, averaged over 2 x 2 pixels.
    """

    places: tuple[int, ...]
    one_ray: NDArray[np.float32]
    finer: NDArray[np.float32]


def finer_views(
    dataset: Dataset,
    scene_name: str,
    request: ViewRequest,
    *,
    edit: Mapping[str, Edit] | None = None,
    count: int = FLOOR_VIEWS,
) -> Finer:
    """What the truth itself may be measured against: independent pictures of evenly spaced views.

    Args:
        dataset: with volumes.
        scene_name: one of its basic scenes or compositions.
        request: whose views.
        edit: as for :func:`views_of`.
        count: number of views.

    Raises:
        UnknownName, DataError: as :func:`views_of`.
    """
    from econgs_bench.datasets.prerendered import area_average

    job = RenderJob.of(dataset, _edited(dataset.parts(scene_name), edit), request)
    places = evenly_spaced(len(job.places), count)
    cameras = tuple(job.cameras[job.places[i]] for i in places)
    double = tuple(camera.resized(2 * request.width, 2 * request.height) for camera in cameras)
    marcher = _marcher(job.volumes, job.backend)
    one_ray = marcher.prepare(job.layers, 1)(cameras)
    finer = marcher.prepare(job.layers, ADAPTIVE)(double)
    means = [area_average(image, request.width, request.height, scene_name) for image in finer]
    return Finer(tuple(places), one_ray, np.stack(means))


@dataclass(frozen=True)
class LiveRenderer:
    """A renderer of one scene, warmed up, for views one by one as a viewer draws them; nothing is cached.

    Attributes:
        render: draws one view, (height, width, 4) float32 premultiplied RGBA.
        cameras: cameras of the request.
        setup_seconds: from volumes in memory to the first picture.
        about: renderer, version and backend.
    """

    render: Callable[[Camera], NDArray[np.float32]]
    cameras: tuple[Camera, ...]
    setup_seconds: float
    about: dict[str, Any]


def live_renderer(dataset: Dataset, scene_name: str, request: ViewRequest) -> LiveRenderer:
    """Set up the renderer of a scene or composition to draw views one by one.

    Raises:
        UnknownName: no such scene.
        DataError: the dataset has no volume, or the request cannot be met.
    """
    if dataset.kind == "views":
        raise DataError(dataset.name, "was rendered elsewhere", "Name a dataset with a volume")
    job = RenderJob.of(dataset, dataset.parts(scene_name), request)
    draw, seconds = job.set_up()
    return LiveRenderer(lambda camera: draw((camera,))[0], job.cameras, seconds, job.renderer)


def marcher_of(volumes: Sequence[Volume], backend: probe.Backend) -> Marcher:
    """The ray marcher that draws the ground truth, on volumes of one grid and box.

    Args:
        volumes: at least one.
        backend: of :func:`.datasets.ground_truth.probe.find_backend`; without one the reference marcher.

    Raises:
        DataError: the volumes differ in grid or box.
    """
    if backend.name == "none":
        if backend.reason:
            _notice(backend)
        import torch

        from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher

        return ReferenceMarcher(volumes, dtype=torch.float32, device=_torch_device())
    probe.activate(backend)
    from econgs_bench.datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    return MitsubaMarcher(volumes)


@lru_cache(maxsize=1)
def _marcher(volumes: tuple[Volume, ...], backend: probe.Backend) -> Marcher:
    """The marcher of the last scene: several sets of its views follow each other."""
    return marcher_of(volumes, backend)


def volume_digest(volume: Volume) -> str:
    """Content hash of a volume's values, type, spacing, range, mask and vertices; computed once."""
    if volume not in _digests:
        about = (volume.values.shape, volume.values.dtype.str, volume.spacing, volume.value_range)
        digest = hashlib.sha256(repr(about).encode())
        for part in volume.values:
            digest.update(np.ascontiguousarray(part).data)
        for name in ("mask", "vertices", "vertex_values"):
            array = getattr(volume, name)
            if array is not None:
                digest.update(f"{name} {array.shape} {array.dtype.str}".encode())
                for part in array:
                    digest.update(np.ascontiguousarray(part).data)
        _digests[volume] = digest.hexdigest()
    return _digests[volume]


@dataclass(frozen=True, eq=False)
class RenderJob:
    """The views of a request that are rendered together, and by what.

    Attributes:
        layers: parts of the scene, drawn in one picture.
        volumes: distinct volumes of the layers, on one grid.
        cameras: all training or all test cameras of the request.
        places: positions of the views of its split among ``cameras``.
        samples: rays a pixel, or :data:`.datasets.ground_truth.sampling.ADAPTIVE`.
        backend: of Mitsuba; "none" for the reference marcher.
    """

    layers: tuple[Layer, ...]
    volumes: tuple[Volume, ...]
    cameras: tuple[Camera, ...]
    places: tuple[int, ...]
    samples: int
    backend: probe.Backend

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        parts: tuple[BasicScene, ...],
        request: ViewRequest,
        renderer: Renderer = "auto",
    ) -> RenderJob:
        """The job of a scene's parts.

        Raises:
            DataError: parts or request that cannot be drawn, or no backend for ``renderer``.
        """
        _check_parts(dataset, parts)
        name = f"{dataset.name}/{' + '.join(scene.name for scene in parts)}"
        layers = tuple(Layer.of(scene, dataset.volume(scene.variable)) for scene in parts)
        volumes = same_grid([layer.volume for layer in layers], name)
        if min(request.width, request.height) < 1:
            raise DataError(
                f"{request.width}x{request.height} views",
                "there must be at least one pixel",
                "Ask for 128x128, say",
            )
        cameras = _cameras(volumes[0], dataset.frame, request)
        places = split_indices(len(cameras), request.split)
        if not places:
            raise DataError(
                f"validation split of {request.train_views} training views",
                "every tenth view is validation and there are fewer than ten",
                "Use 12 or more training views",
            )
        samples = checked(request.samples, name)
        return cls(layers, volumes, cameras, tuple(places), samples, _backend(renderer))

    def set_up(self) -> tuple[Draw, float]:
        """The function that draws views of this scene, and the seconds until it was ready."""
        start = time.perf_counter()
        draw = _marcher(self.volumes, self.backend).prepare(self.layers, self.samples)
        if self.backend.name != "none":
            draw(self.cameras[:1])  # compiles the kernel
        return draw, time.perf_counter() - start

    def render(self, progress: Progress | None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The images and their cost (:attr:`.datasets.views.ViewSet.cost`)."""
        draw, setup_seconds = self.set_up()
        ready = time.perf_counter()
        images = draw(self.cameras, progress)
        seconds = time.perf_counter() - ready
        record = {
            **self.renderer,
            "ms_per_view": 1e3 * seconds / len(images),
            "setup_seconds": setup_seconds,
            "peak_host_bytes": peak_host_bytes(),
            "peak_device_bytes": peak_drjit_device_bytes(),
            "views": len(images),
            "width": images.shape[2],
            "height": images.shape[1],
        }
        return images, record

    @property
    def renderer(self) -> dict[str, Any]:
        """Name, version and backend of what draws."""
        if self.backend.name == "none":
            backend = {"cpu": "torch", "cuda": "torch-cuda"}[_torch_device()]
            return {"renderer": "reference", "version": version("torch"), "backend": backend}
        return {
            "renderer": "mitsuba",
            "version": f"{version('mitsuba')}+drjit{version('drjit')}",
            "backend": self.backend.name,
        }

    @cached_property
    def key(self) -> str:
        """Name of the views in the cache: a hash of all that decides their pixels."""
        parts = [_ingredients(layer) for layer in self.layers]
        settings = asdict(MarchSettings())
        if self.samples != 1:  # keys of one ray are those of before there was a choice
            settings |= {"samples": self.samples, "sampling": SAMPLING_VERSION}
        ingredients = {
            "model": MODEL_VERSION,
            "cameras": hashlib.sha256(b"".join(_bytes(c) for c in self.cameras)).hexdigest(),
            "settings": settings,
            "renderer": self.renderer,
            **(parts[0] if len(parts) == 1 else {"parts": parts}),
        }
        return hashlib.sha256(json.dumps(ingredients, sort_keys=True).encode()).hexdigest()[:40]


def _check_parts(dataset: Dataset, parts: tuple[BasicScene, ...]) -> None:
    for scene in parts:
        if (scene.transfer is None) == (not scene.isosurfaces):
            raise DataError(
                f"{dataset.name}/{scene.name}",
                "the scene has both a transfer function and isosurfaces"
                if scene.isosurfaces
                else "the scene has no transfer function",
                "Give it one or the other in the catalogue",
            )


def _torch_device() -> str:
    """Where the reference marcher runs."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _edited(parts: tuple[BasicScene, ...], edit: Mapping[str, Edit] | None) -> tuple[BasicScene, ...]:
    for name in edit or {}:
        if name not in [scene.name for scene in parts]:
            raise unknown("edited scene", name, [scene.name for scene in parts])
    return tuple(edited(scene, edit[scene.name]) if edit and scene.name in edit else scene for scene in parts)


def _cameras(volume: Volume, frame: Frame | None, request: ViewRequest) -> tuple[Camera, ...]:
    """All training or all test cameras around a frame, or around a volume."""
    radius = request.distance * (frame.radius if frame else 0.5 * float(np.linalg.norm(volume.extent)))
    centre = frame.centre if frame else None
    if request.split == "test":
        return test_cameras(
            request.test_views, radius, request.width, request.height, centre, step=request.step
        )
    return training_cameras(request.train_views, radius, request.width, request.height, centre)


_SLOW = (
    "ground truth comes from the slow reference marcher, 15 to 50 times slower than Mitsuba, which has no "
    "working backend here: %s. %s"
)


def _backend(renderer: Renderer) -> probe.Backend:
    if renderer == "reference":
        return probe.Backend("none")
    backend = probe.find_backend()
    if backend.name == "none" and renderer == "mitsuba":
        raise DataError("Mitsuba", f"it has no working backend here: {backend.reason}", backend.remedy)
    return backend


@once
def _notice(backend: probe.Backend) -> None:
    _log.warning(_SLOW, backend.reason, backend.remedy)


def announce_slow() -> None:
    """Give the notice of a slow renderer now, before data are read, instead of at the first view."""
    backend = probe.find_backend()
    if backend.name == "none":
        _notice(backend)


def slow_notice() -> str:
    """Why ground truth will be slow here, and the remedy; "" where Mitsuba works."""
    backend = probe.find_backend()
    return _SLOW % (backend.reason, backend.remedy) if backend.name == "none" else ""


def _ingredients(layer: Layer) -> dict[str, Any]:
    """The part of a layer that decides pictures: no names, nothing that is off."""
    transfer = asdict(layer.transfer) if layer.transfer else None
    if transfer is not None:
        transfer.pop("name")
        for bump in transfer["bumps"]:
            bump.pop("name")
    light = asdict(layer.light) if layer.light else None
    if light is not None and light["model"] == "blinn-phong":
        light.pop("model")
    parts: dict[str, Any] = {"volume": volume_digest(layer.volume), "transfer": transfer, "light": light}
    if layer.isosurfaces:
        parts["isosurfaces"] = [(s.value, s.color, s.opacity) for s in layer.isosurfaces]
    if layer.depth_enhancement > 0.0:
        parts["depth_enhancement"] = layer.depth_enhancement
    if layer.narrow:  # before, one table and one floor served all
        parts["resolved"] = 1
    return parts


def _bytes(camera: Camera) -> bytes:
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return np.concatenate([camera.camera_to_world.ravel(), numbers]).tobytes()
