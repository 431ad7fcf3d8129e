"""Blender-style ``transforms_*.json``: the only place that converts camera conventions.

In these files (as in NeRF's synthetic data) a camera looks along -z with +y up; here it looks along +z
with +y down. The world is the same.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera, with_near_planes
from datasets.errors import DataError
from datasets.png import open_picture

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_REMEDY = "Write it as NeRF's synthetic data: camera_angle_x and frames with file_path and transform_matrix"


def read_transforms(path: Path | str) -> list[tuple[Camera, Path]]:
    """Cameras and image files of a ``transforms_*.json``.

    Intrinsics come from ``camera_angle_x``, or ``fl_x`` (``fl_y``, ``cx``, ``cy``), of the frame or of the
    file; the image size from ``w`` and ``h``, else from the header of each image. ``.png`` is added to a
    path without a suffix. Rotations are made exactly orthonormal.

    Raises:
        DataError: the file is unreadable or incomplete, or a matrix is no rigid transform.
    """
    path = Path(path)
    fields = _read_json(path)
    frames = fields.get("frames")
    if not (isinstance(frames, list) and frames and all(isinstance(f, dict) for f in frames)):
        raise DataError(path, "has no frames", _REMEDY)
    views = [_frame(path, i, {**fields, **frame}) for i, frame in enumerate(frames)]
    cameras = with_near_planes([camera for camera, _ in views])
    return [(camera, image) for camera, (_, image) in zip(cameras, views, strict=True)]


def _read_json(path: Path) -> dict[str, Any]:
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(path, "no such file", "Check the folder of pre-rendered views") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, f"is not readable JSON ({error})", _REMEDY) from error
    if not isinstance(fields, dict):
        raise DataError(path, "is no JSON object", _REMEDY)
    return fields


def _frame(path: Path, index: int, fields: dict[str, Any]) -> tuple[Camera, Path]:
    file_path = fields.get("file_path")
    if not isinstance(file_path, str) or not file_path:
        raise DataError(path, f"frame {index} has no file_path", _REMEDY)
    image = path.parent / file_path
    if not image.suffix:
        image = image.with_name(image.name + ".png")
    matrix = _rigid(path, index, fields.get("transform_matrix"))
    width, height = (_number(path, index, fields, key) for key in ("w", "h"))
    if width is None or height is None:
        with open_picture(image) as picture:
            width, height = picture.size
    fx = _number(path, index, fields, "fl_x")
    if fx is None:
        angle = _number(path, index, fields, "camera_angle_x")
        if angle is None or not 0.0 < angle < math.pi:
            raise DataError(path, f"frame {index} has neither fl_x nor a camera_angle_x in (0, pi)", _REMEDY)
        fx = 0.5 * width / math.tan(0.5 * angle)
    fy, cx, cy = (_number(path, index, fields, key) for key in ("fl_y", "cx", "cy"))
    camera = Camera(
        matrix,
        fx,
        fx if fy is None else fy,
        0.5 * width if cx is None else cx,
        0.5 * height if cy is None else cy,
        int(width),
        int(height),
        image.stem,
    )
    if not (camera.fx > 0.0 and camera.fy > 0.0 and camera.width > 0 and camera.height > 0):
        raise DataError(path, f"frame {index} has a focal length or size that is not positive", _REMEDY)
    return camera, image


def _number(path: Path, index: int, fields: dict[str, Any], key: str) -> float | None:
    value = fields.get(key)
    if value is None:
        return None
    number = math.nan
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise DataError(path, f"{key} of frame {index} is not a number", _REMEDY)
    return number


def _rigid(path: Path, index: int, value: Any) -> NDArray[np.float64]:
    """The OpenCV camera-to-world of a Blender matrix; exporters add rounding noise of about 1e-6."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise DataError(path, f"transform_matrix of frame {index} is not 4 x 4 numbers", _REMEDY)
    rotation = matrix[:3, :3]
    u, singular, vt = np.linalg.svd(rotation)
    if np.abs(singular - 1.0).max() > 1e-3 or np.linalg.det(rotation) < 0.0:
        reason = f"transform_matrix of frame {index} is not a rotation with a translation"
        raise DataError(path, reason, "Export cameras without scale or mirroring")
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = matrix[:3, 3]
    return np.asarray(rigid @ _FLIP)
