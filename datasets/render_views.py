"""The ground-truth views of a scene: rendered, from the cache, or read where they were rendered elsewhere."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache as once
from importlib.metadata import version
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from datasets.camera_paths import test_cameras, training_cameras
from datasets.errors import DataError
from datasets.ground_truth import probe
from datasets.ground_truth.model import MODEL_VERSION, Marcher, MarchSettings, Progress
from datasets.memory import peak_drjit_device_bytes, peak_host_bytes
from datasets.scene import BasicScene, Dataset, Light
from datasets.view_cache import CachedViews, ViewCache
from datasets.views import ViewRequest, ViewSet, split_indices
from datasets.volume import Volume

Renderer = Literal["auto", "mitsuba", "reference"]

_log = logging.getLogger(__name__)
_digests: WeakKeyDictionary[Volume, str] = WeakKeyDictionary()


def views_of(
    dataset: Dataset,
    scene_name: str,
    request: ViewRequest,
    *,
    renderer: Renderer = "auto",
    cache: ViewCache | None = None,
    progress: Progress | None = None,
) -> ViewSet:
    """The views that a request names, of one basic scene.

    All training views are rendered and cached together, whichever split is asked for.

    Args:
        dataset: with volumes (views are rendered) or with views only (they are read).
        scene_name: one of its basic scenes.
        request: split, numbers and size.
        renderer: "auto" takes Mitsuba where it works, else the reference marcher, with a notice.
        cache: default the user's.
        progress: called with views done and views in all while rendering.

    Raises:
        UnknownName: no such scene.
        DataError: the request cannot be met, or Mitsuba was asked for and cannot run.
    """
    scene = dataset.scene(scene_name)
    if dataset.kind == "views":
        from datasets.prerendered import load_views

        prerendered: ViewSet = load_views(scene, request)
        return prerendered
    cache = ViewCache() if cache is None else cache
    work = _Work(dataset, scene, request, renderer)
    views = cache.get(work.key)
    if views is None:
        images, record = work.render(progress)
        views = CachedViews(cache.put(work.key, images, record), record)
    if len(work.chosen) == len(work.cameras):
        return ViewSet(work.cameras, views.images, scene.background, work.key)
    cameras = tuple(work.cameras[i] for i in work.chosen)
    return ViewSet(cameras, views.images[work.chosen], scene.background, f"{work.key}-{request.split}")


def render_cost(
    dataset: Dataset,
    scene_name: str,
    request: ViewRequest,
    *,
    renderer: Renderer = "auto",
    cache: ViewCache | None = None,
) -> dict[str, Any] | None:
    """What rendering the cached views cost; None if none are cached.

    ``ms_per_view`` of launches that hold several small views, ``setup_seconds``, renderer and backend, and
    ``peak_host_bytes``, ``peak_device_bytes`` of the process that rendered them, up to then.
    """
    if dataset.kind == "views":
        return None
    cache = ViewCache() if cache is None else cache
    return cache.record(_Work(dataset, dataset.scene(scene_name), request, renderer).key)


def cameras_of(dataset: Dataset, scene_name: str, request: ViewRequest) -> tuple[Camera, ...]:
    """The cameras of the views that a request names, without rendering or reading any picture of size."""
    parts = dataset.parts(scene_name)
    if dataset.kind == "views":
        from datasets.prerendered import view_cameras

        return view_cameras(parts[0], request)
    cameras = _cameras(dataset.volume(parts[0].variable), request)
    return tuple(cameras[i] for i in split_indices(len(cameras), request.split))


@dataclass(frozen=True)
class LiveRenderer:
    """A renderer of one scene that is set up and warm, as a viewer would hold it; nothing is cached.

    Attributes:
        render: draws one view, (height, width, 4) float32 premultiplied RGBA.
        cameras: of the request.
        setup_seconds: from volumes in memory to the first picture.
        about: renderer, version and backend.
    """

    render: Callable[[Camera], NDArray[np.float32]]
    cameras: tuple[Camera, ...]
    setup_seconds: float
    about: dict[str, Any]


def live_renderer(
    dataset: Dataset, scene_name: str, request: ViewRequest, *, renderer: Renderer = "auto"
) -> LiveRenderer:
    """Set up the renderer of a scene to draw views one by one.

    Raises:
        UnknownName: no such scene.
        DataError: the dataset has no volume, or the request cannot be met.
    """
    if dataset.kind == "views":
        raise DataError(dataset.name, "was rendered elsewhere", "Name a dataset with a volume")
    work = _Work(dataset, dataset.scene(scene_name), request, renderer)
    draw, seconds = work.set_up()
    return LiveRenderer(lambda camera: draw((camera,), None)[0], work.cameras, seconds, work._renderer())


def volume_digest(volume: Volume) -> str:
    """Content hash of a volume's values, type, spacing, range, mask and vertices; computed once per volume."""
    if volume not in _digests:
        about = (volume.values.shape, volume.values.dtype.str, volume.spacing, volume.value_range)
        digest = hashlib.sha256(repr(about).encode())
        digest.update(np.ascontiguousarray(volume.values).data)
        for name in ("mask", "vertices", "vertex_values"):
            array = getattr(volume, name)
            if array is not None:
                digest.update(f"{name} {array.shape} {array.dtype.str}".encode())
                digest.update(np.ascontiguousarray(array).data)
        _digests[volume] = digest.hexdigest()
    return _digests[volume]


class _Work:
    """A request made concrete: cameras, renderer and key."""

    def __init__(self, dataset: Dataset, scene: BasicScene, request: ViewRequest, renderer: Renderer) -> None:
        if scene.transfer is None:
            raise DataError(
                f"{dataset.name}/{scene.name}",
                "the scene has no transfer function",
                "Give it one in the catalogue",
            )
        if min(request.width, request.height) < 1:
            raise DataError(
                f"{request.width}x{request.height} views",
                "there must be at least one pixel",
                "Ask for 128x128, say",
            )
        self.transfer, self.light = scene.transfer, scene.light
        self.volume = dataset.volume(scene.variable)
        self.cameras = _cameras(self.volume, request)
        self.chosen = split_indices(len(self.cameras), request.split)
        if not self.chosen:
            raise DataError(
                f"validation split of {request.train_views} training views",
                "every tenth view is validation and there are fewer than ten",
                "Use 12 or more training views",
            )
        self.settings = MarchSettings()
        self.backend = _backend(renderer)
        self.key = self._key()

    def set_up(self) -> tuple[Callable[[tuple[Camera, ...], Progress | None], NDArray[np.float32]], float]:
        """A function that draws views of this scene, and the seconds until it was ready."""
        started = time.perf_counter()
        marcher = self._marcher()
        if self.backend.name != "none":
            marcher.render(self.cameras[:1], self.transfer, self.light)  # compiles the kernel
        seconds = time.perf_counter() - started
        return lambda cameras, progress: marcher.render(cameras, self.transfer, self.light, progress), seconds

    def render(self, progress: Progress | None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The images and the record of what they cost."""
        draw, setup_seconds = self.set_up()
        ready = time.perf_counter()
        images = draw(self.cameras, progress)
        seconds = time.perf_counter() - ready
        record = {
            **self._renderer(),
            "ms_per_view": 1e3 * seconds / len(images),
            "setup_seconds": setup_seconds,
            "peak_host_bytes": peak_host_bytes(),
            "peak_device_bytes": peak_drjit_device_bytes(),
            "views": len(images),
            "width": images.shape[2],
            "height": images.shape[1],
        }
        return images, record

    def _marcher(self) -> Marcher:
        if self.backend.name == "none":
            if self.backend.reason:
                _notice(self.backend.reason)
            import torch

            from datasets.ground_truth.reference import ReferenceMarcher

            return ReferenceMarcher(self.volume, self.settings, torch.float32)
        probe.activate(self.backend)
        from datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

        return MitsubaMarcher(self.volume, self.settings)

    def _renderer(self) -> dict[str, Any]:
        if self.backend.name == "none":
            return {"renderer": "reference", "version": version("torch"), "backend": "torch"}
        return {
            "renderer": "mitsuba",
            "version": f"{version('mitsuba')}+drjit{version('drjit')}",
            "backend": self.backend.name,
        }

    def _key(self) -> str:
        transfer = asdict(self.transfer)
        # Names do not change a picture.
        transfer.pop("name")
        for bump in transfer["bumps"]:
            bump.pop("name")
        ingredients = {
            "model": MODEL_VERSION,
            "volume": volume_digest(self.volume),
            "transfer": transfer,
            "light": _said(self.light) if self.light else None,
            "cameras": hashlib.sha256(b"".join(_bytes(c) for c in self.cameras)).hexdigest(),
            "settings": asdict(self.settings),
            "renderer": self._renderer(),
        }
        return hashlib.sha256(json.dumps(ingredients, sort_keys=True).encode()).hexdigest()[:40]


def _cameras(volume: Volume, request: ViewRequest) -> tuple[Camera, ...]:
    """All training or all test cameras around a volume."""
    radius = 0.5 * float(np.linalg.norm(volume.extent))
    if request.split == "test":
        return test_cameras(request.test_views, radius, request.width, request.height)
    return training_cameras(request.train_views, radius, request.width, request.height)


def _backend(renderer: Renderer) -> probe.Backend:
    if renderer == "reference":
        return probe.Backend("none")
    backend = probe.find_backend()
    if backend.name == "none" and renderer == "mitsuba":
        raise DataError("Mitsuba", f"it has no working backend here: {backend.reason}", probe.REMEDY)
    return backend


@once
def _notice(reason: str) -> None:
    _log.warning(
        "ground truth comes from the slow reference marcher, as Mitsuba has no working backend here: %s. %s",
        reason,
        probe.REMEDY,
    )


def _said(light: Light) -> dict[str, Any]:
    """A light as it enters keys: what was there from the first, and what differs from the default."""
    said = asdict(light)
    if light.model == "blinn-phong":
        said.pop("model")
    return said


def _bytes(camera: Camera) -> bytes:
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return np.concatenate([camera.camera_to_world.ravel(), numbers]).tobytes()
