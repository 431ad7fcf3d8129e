"""Ground truth as a views job stores it and all later jobs read it.

views.json     the scene; of each split its cameras and the index of its pictures
SPLIT.zst      pictures, bit for bit as they were rendered or read
cloud.npz      what initial clouds are drawn from (scenes that methods train on)
truth/*.png    the views that are measured on, in 8 bits: for pages and people
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.bench.store.store import write_text
from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.seals import sealed, unsealed
from econgs_bench.datasets.view_files import images_bytes, read_views, write_views
from econgs_bench.datasets.views import Split, ViewSet

if TYPE_CHECKING:
    from econgs_bench.datasets.cloud import CloudSource, PointCloud
    from econgs_bench.datasets.scene import BasicScene

FILES = "files"
"""Renderer of pre-rendered views."""
INDEX = "views.json"
_CLOUD = "cloud.npz"
_MOST_VALUES = 10_000_000
"""Values of the index; a camera has about 30."""


def write_truth(
    folder: Path, sets: dict[Split, ViewSet], scene: BasicScene | None, cloud: CloudSource | None
) -> None:
    """Store views by split, and the definition and cloud source of a scene that methods train on."""
    index: dict[str, Any] = {
        "scene": None if scene is None else _definitions().dump_python(scene, mode="json")
    }
    index["splits"] = {
        split: {
            "key": views.key,
            "background": views.background,
            "cameras": [_camera_to_json(camera) for camera in views.cameras],
            "pictures": _store(folder / f"{split}.zst", views),
        }
        for split, views in sets.items()
    }
    if cloud is not None:
        cloud.save(folder / _CLOUD)
    write_text(folder / INDEX, sealed(json.dumps(index)))


def _store(file: Path, views: ViewSet) -> dict[str, Any]:
    """The index of a file that holds the pictures: the cache's own under a second name, or a new one."""
    from econgs_bench.datasets.view_cache import ViewCache

    file.unlink(missing_ok=True)  # of an attempt that was killed
    return ViewCache().link(views.key, file) or write_views(file, views.images)


class Truth:
    """Reads the folder of a views job.

    Raises:
        DataError: a file is missing or damaged; so do all methods.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._index: dict[str, Any] = self._read(
            INDEX, lambda file: json_of(unsealed(file.read_text(encoding="utf-8")), _MOST_VALUES)
        )

    def cameras(self, split: Split) -> tuple[Camera, ...]:
        """Cameras of a split, without its pictures."""
        return tuple(_camera_from_json(camera) for camera in self._index["splits"][split]["cameras"])

    def images_bytes(self, split: Split) -> int:
        """Size of a split's pictures in memory."""
        return images_bytes(self._index["splits"][split]["pictures"])

    def views(self, split: Split, which: Sequence[int] | None = None, together: int = 0) -> ViewSet:
        """Views of a split, all or those at some positions.

        Args:
            split: one that the views job stored.
            which: positions; default: all.
            together: bytes of all pictures that are held with these: beyond
                :data:`.datasets.scratch.LIMIT` they lie in a file, and the system reads what is looked at.
        """
        stored = self._index["splits"][split]
        cameras = self.cameras(split)
        images = self._read(
            f"{split}.zst", lambda file: read_views(file, stored["pictures"], which, together)
        )
        if which is not None:
            cameras = tuple(cameras[place] for place in which)
        return ViewSet(cameras, images, tuple(stored["background"]), stored["key"])

    def scene(self) -> BasicScene:
        """Definition of the basic scene."""
        scene: BasicScene = _definitions().validate_python(self._index["scene"])
        return scene

    def cloud(self, points: int, seed: int) -> PointCloud:
        """An initial cloud of the basic scene (:meth:`.datasets.cloud.CloudSource.draw`)."""
        from econgs_bench.datasets.cloud import CloudSource

        source: CloudSource = self._read(_CLOUD, CloudSource.load)
        return source.draw(self.scene(), points, seed)

    def _read(self, name: str, reader: Callable[[Path], Any]) -> Any:
        import zlib
        from zipfile import BadZipFile

        try:
            return reader(self._folder / name)
        except (OSError, ValueError, KeyError, TypeError, BadZipFile, zlib.error) as error:
            raise DataError(
                self._folder / name,
                f"the stored ground truth cannot be read ({error})",
                "Delete its folder, and bench run makes it again",
            ) from error


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    """A camera as JSON values; floats survive exactly."""
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "camera_to_world": camera.camera_to_world.tolist(),
        "near": camera.near,
    }


def _camera_from_json(data: dict[str, Any]) -> Camera:
    """Inverse of :func:`_camera_to_json`."""
    fx, fy, cx, cy = data["intrinsics"]
    matrix = np.asarray(data["camera_to_world"], dtype=np.float64)
    near = data.get("near", 0.2)  # of stores of version 0.2 and before
    return Camera(matrix, fx, fy, cx, cy, data["width"], data["height"], data["name"], near)


@cache
def _definitions() -> Any:
    """Converts scenes to JSON values and back."""
    from pydantic import TypeAdapter

    from econgs_bench.datasets.scene import BasicScene

    return TypeAdapter(BasicScene)


def renderer_of(cost: Mapping[str, Any] | None) -> str:
    """Renderer of views, from the cost of rendering them; pre-rendered views have none."""
    if not cost:
        return FILES
    return " ".join(str(cost[name]) for name in ("renderer", "version", "backend") if cost.get(name))


def sketch(views: ViewSet) -> str:
    """Mean and root mean square of each view's four channels, 16 bits each: a mark of the pictures.

    Two renderers of one scene differ by rounding, which a hash of the pictures would not forgive.
    """
    rows = []
    for image in views.images:  # one by one: large views lie in files
        values = np.asarray(image, dtype=np.float64).reshape(-1, 4)
        rows.append([*values.mean(axis=0), *np.sqrt((values**2).mean(axis=0))])
    values = np.clip(rows, 0.0, 1.0)
    return base64.b64encode(np.round(values * 65535).astype("<u2").tobytes()).decode()
