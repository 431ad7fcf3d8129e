"""What a method gives back, checked: a wrong type or shape is a failure in words, never a wrong number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.jobs.monitor import as_numpy
from econgs_bench.datasets.camera import Camera
from econgs_bench.methods.interface import Decoding


def picture(answer: Any, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    """Colors and alpha of a rendered view.

    Raises:
        RuntimeError: they are not those that :meth:`.methods.interface.Model.render` promises.
        FloatingPointError: their values are not finite.
    """
    view = f"in view {camera.name}"
    shape = (camera.height, camera.width)
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise RuntimeError(f"the loaded model renders a {type(answer).__name__} {view}, not colors and alpha")
    rgb, alpha = (as_numpy(part) for part in answer)
    for what, part, wanted in (("colors", rgb, (*shape, 3)), ("alpha", alpha, shape)):
        if part.shape != wanted or part.dtype.kind != "f":
            found = f"{what} {part.shape} of {part.dtype}"
            raise RuntimeError(f"the loaded model renders {found} {view}, not {wanted} of floats")
    if not (np.isfinite(rgb).all() and np.isfinite(alpha).all()):
        raise FloatingPointError(f"the loaded model renders values that are not finite {view}")
    return rgb, alpha


def primitives(value: Any) -> int:
    """A number of primitives.

    Raises:
        RuntimeError: it is none.
    """
    if not isinstance(value, Integral) or value < 0:
        raise RuntimeError(f"the model says that it has {value!r} primitives, not a whole number")
    return int(value)


def timings(value: Any) -> dict[str, float]:
    """Seconds of the parts of a frame.

    Raises:
        RuntimeError: they are none.
    """
    if not isinstance(value, Mapping) or not all(
        isinstance(part, str) and isinstance(seconds, Real) and math.isfinite(seconds)
        for part, seconds in value.items()
    ):
        raise RuntimeError(f"the timings of a frame are {value!r}, not seconds by part")
    return {part: float(seconds) for part, seconds in value.items()}


def decoding(value: Any) -> Decoding:
    """When the networks of a model run.

    Raises:
        RuntimeError: it is no such answer.
    """
    if value not in get_args(Decoding):
        raise RuntimeError(
            f"the decoding of the model is {value!r}, not one of {', '.join(get_args(Decoding))}"
        )
    return cast("Decoding", value)


def attributes(value: Any) -> dict[str, NDArray[Any]]:
    """Attributes of primitives, a row each.

    Raises:
        RuntimeError: they are none.
    """
    if not isinstance(value, Mapping):
        raise RuntimeError(f"the attributes are a {type(value).__name__}, not rows by name")
    found = {str(name): np.asarray(as_numpy(rows)) for name, rows in value.items()}
    for name, rows in found.items():
        if rows.ndim != 2 or rows.dtype.kind not in "fiu" or not np.isfinite(rows).all():
            raise RuntimeError(f"the attributes {name!r} are {rows.shape} of {rows.dtype}, not finite rows")
    return found


def ledger(value: Any) -> dict[str, dict[str, int]]:
    """Bytes of a saved model by scene and part.

    Raises:
        RuntimeError: they are none.
    """
    if not isinstance(value, Mapping) or not all(
        isinstance(scene, str)
        and isinstance(parts, Mapping)
        and all(isinstance(part, str) and isinstance(size, Integral) for part, size in parts.items())
        for scene, parts in value.items()
    ):
        raise RuntimeError(f"the byte ledger is {value!r}, not whole numbers by scene and part")
    return {scene: {part: int(size) for part, size in parts.items()} for scene, parts in value.items()}
