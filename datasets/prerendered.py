"""Pre-rendered views: the pictures and cameras of a folder (:mod:`.datasets.posed_images`) as truth."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import read_png
from econgs_bench.datasets.posed_images import read_frames
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.scratch import new_array
from econgs_bench.datasets.views import ViewRequest, ViewSet, evenly_spaced, split_indices

_log = logging.getLogger(__name__)


def load_views(scene: BasicScene, request: ViewRequest) -> ViewSet:
    """The views that a request names.

    A request for fewer views than the folder holds takes evenly spaced ones in file order; a request for more
    takes all. Validation views are every tenth of these training views.

    Args:
        scene: pre-rendered, with ``views_folder``.
        request: its size must divide the size of the pictures.

    Raises:
        DataError: the folder, a camera or a picture is unusable; the size does not divide; or the split is
            empty.
    """
    source, selection = _selection(scene, request)
    digest = hashlib.sha256(repr((request.width, request.height, scene.background)).encode())
    cameras: list[Camera] = []
    images = new_array((len(selection), request.height, request.width, 4), np.float32)
    opaque = 0
    for row, (camera, file) in enumerate(selection):
        image = read_png(file, deep=True)
        height, width = image.shape[:2]
        if abs(width * camera.height - height * camera.width) > 2 * max(camera.width, camera.height):
            raise DataError(
                file,
                f"is {width}x{height} pixels, but its camera {camera.width}x{camera.height}",
                "Give pictures of the cameras' shape",
            )
        if (camera.width, camera.height) != (width, height):
            camera = camera.resized(width, height)
        opaque += bool((image[..., 3] == 1.0).all())
        images[row] = area_average(image, request.width, request.height, file)
        camera = camera.resized(request.width, request.height)
        cameras.append(camera)
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
        digest.update(np.concatenate([camera.camera_to_world.ravel(), numbers]).tobytes())
        digest.update(images[row].tobytes())
    if opaque == len(selection):
        _log.warning("%s: no picture has transparency; its background is taken as part of the scene", source)
    return ViewSet(tuple(cameras), images, scene.background, digest.hexdigest()[:40])


def view_cameras(scene: BasicScene, request: ViewRequest) -> tuple[Camera, ...]:
    """The cameras of :func:`load_views`, without reading pictures.

    Raises:
        DataError: the folder or a camera is unusable, or the split is empty.
    """
    return tuple(camera.resized(request.width, request.height) for camera, _ in _selection(scene, request)[1])


def _selection(scene: BasicScene, request: ViewRequest) -> tuple[str, list[tuple[Camera, Path]]]:
    """What they are of, for messages, and the cameras and pictures of a request."""
    if scene.views_folder is None:
        raise DataError(f"scene {scene.name}", "it has no pre-rendered views", "Render it from its volume")
    test = request.split == "test"
    source = f"{'test' if test else 'training'} views of {scene.views_folder}"
    views = read_frames(scene.views_folder, "test" if test else "train")
    indices = evenly_spaced(len(views), request.test_views if test else request.train_views)
    selection = [views[indices[i]] for i in split_indices(len(indices), request.split)]
    if not selection:
        raise DataError(
            f"{request.split} split of the {len(indices)} {source}",
            "it is empty (every tenth training view is validation)",
            "Use 12 or more training views",
        )
    return source, selection


def area_average(
    image: NDArray[np.float32], width: int, height: int, what: Path | str
) -> NDArray[np.float32]:
    """Mean over blocks of a premultiplied picture.

    Raises:
        DataError: the size does not divide the picture's.
    """
    rows, columns = image.shape[:2]
    if (columns, rows) == (width, height):
        return image
    if min(width, height) < 1 or columns % width or rows % height or columns // width != rows // height:
        sizes = [f"{columns // k}x{rows // k}" for k in (1, 2, 4, 5, 8) if columns % k == 0 and rows % k == 0]
        reason = f"{columns}x{rows} pixels do not divide evenly into {width}x{height}"
        raise DataError(what, reason, f"Pre-rendered views can be had at {', '.join(sizes)}")
    factor = columns // width
    blocks = image.reshape(height, factor, width, factor, image.shape[2])
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32))
