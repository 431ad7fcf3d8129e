"""``transforms*.json`` of NeRF's synthetic data, instant-ngp and nerfstudio: pinhole cameras and pictures.

The only place that converts camera conventions: in these files a camera looks along -z with +y up; here it
looks along +z with +y down. The world is the same.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.pictures import find_picture, named
from econgs_bench.datasets.png import open_picture

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_REMEDY = "Write it as NeRF's synthetic data: camera_angle_x and frames with file_path and transform_matrix"
UNDISTORT = "Undistort the pictures (colmap image_undistorter), and write the cameras as PINHOLE"
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
_POLYNOMIALS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are a pinhole where all coefficients are 0."""
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4", "b1", "b2")
_LENSES = (
    "is_fisheye", "fisheye", "is_equirectangular", "equirectangular", "is_panorama", "panorama", "is_latlong",
    "latlong", "is_orthographic", "orthographic", "ortho", "is_ftheta", "ftheta", "ftheta_p0",
    "rolling_shutter", "distortion_params", "distortion", "fisheye_crop_radius",
)  # fmt: skip
"""Keys that say that pictures are not those of a pinhole, unless they are false, 0, or all zeros."""

Frame = tuple[Camera, Path]
"""A camera with its picture."""


def read_transforms(path: Path | str) -> list[Frame]:
    """Cameras and image files of a ``transforms*.json``, by order of the file.

    Focal lengths come from ``fl_x`` (``fl_y``) in pixels, ``camera_angle_x`` (``camera_angle_y``) in radians
    or ``x_fov`` (``y_fov``) in degrees, each of the frame or, where it has none, of the file; pixels are
    square where one axis alone has any. The principal point is ``cx``, ``cy``, else the middle. The size is
    ``w``, ``h``, else that of the picture. Rotations are made exactly orthonormal. Pictures are found and
    views named as :mod:`.datasets.pictures` says.

    Raises:
        DataError: the file is unreadable or incomplete, a picture is missing or occurs twice, a matrix is no
            rigid transform, or a camera is no pinhole (distortion, fisheye, panorama).
    """
    path = Path(path)
    fields = read_fields(path)
    frames = fields.get("frames")
    if not (isinstance(frames, list) and frames and all(isinstance(f, dict) for f in frames)):
        raise DataError(path, "has no frames", _REMEDY)
    return named(path, [_frame(path, i, fields, frame) for i, frame in enumerate(frames)])


def read_fields(path: Path) -> dict[str, Any]:
    """The keys of a file (UTF-8 or UTF-16, with or without a byte order mark).

    Raises:
        DataError: it is missing or no JSON object.
    """
    try:
        fields = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise DataError(path, "no such file", "Check the folder of pre-rendered views") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, f"is not readable JSON ({error})", _REMEDY) from error
    if not isinstance(fields, dict):
        raise DataError(path, "is no JSON object", _REMEDY)
    return fields


def _frame(path: Path, index: int, common: Mapping[str, Any], frame: Mapping[str, Any]) -> Frame:
    fields = {**common, **frame}
    file_path = fields.get("file_path")
    if not isinstance(file_path, str) or not file_path:
        raise DataError(path, f"frame {index} has no file_path", _REMEDY)
    matrix = _rigid(path, index, fields.get("transform_matrix"))
    _check_pinhole(path, index, fields)
    image = find_picture(path.parent, file_path)
    width, height = (_number(path, index, fields, key) for key in ("w", "h"))
    if width is None or height is None:
        with open_picture(image) as picture:
            width, height = picture.size
    fx, fy = (
        next((f for level in (frame, common) if (f := _focal(path, index, level, *axis)) is not None), None)
        for axis in (("x", width), ("y", height))
    )
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise DataError(path, f"frame {index} has neither fl_x nor camera_angle_x", _REMEDY)
    cx, cy = (_number(path, index, fields, key) for key in ("cx", "cy"))
    camera = Camera(
        matrix,
        fx,
        fy,
        0.5 * width if cx is None else cx,
        0.5 * height if cy is None else cy,
        int(width),
        int(height),
    )
    if not (camera.fx > 0.0 and camera.fy > 0.0 and camera.width > 0 and camera.height > 0):
        raise DataError(path, f"frame {index} has a focal length or size that is not positive", _REMEDY)
    return camera, image


def _focal(path: Path, index: int, fields: Mapping[str, Any], axis: str, size: float) -> float | None:
    """Focal length along an axis in pixels, of one level of the file; None if it has none."""
    focal = _number(path, index, fields, f"fl_{axis}")
    if focal is not None:
        return focal
    for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180.0)):
        angle = _number(path, index, fields, key)
        if angle is not None:
            if not 0.0 < angle * unit < math.pi:
                limit = "pi" if unit == 1.0 else "180"
                raise DataError(path, f"{key} of frame {index} is not in (0, {limit})", _REMEDY)
            return 0.5 * size / math.tan(0.5 * angle * unit)
    return None


def _check_pinhole(path: Path, index: int, fields: Mapping[str, Any]) -> None:
    """Raise where a camera is no pinhole: what its picture shows would be drawn at other places."""
    model = fields.get("camera_model")
    if model is not None and (not isinstance(model, str) or model.upper() not in _PINHOLES + _POLYNOMIALS):
        raise DataError(path, f"frame {index} has the camera model {model!r}, no pinhole", UNDISTORT)
    for key in _COEFFICIENTS:
        if value := _number(path, index, fields, key):
            raise DataError(path, f"frame {index} has lens distortion ({key} = {value:g})", UNDISTORT)
    for key in _LENSES:
        value = fields.get(key)
        if any(value) if isinstance(value, list) else bool(value):
            raise DataError(
                path, f"frame {index} has {key} = {json.dumps(value)[:60]}: no pinhole", UNDISTORT
            )


def _number(path: Path, index: int, fields: Mapping[str, Any], key: str) -> float | None:
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
