"""The one function that splats: it checks its input and picks the backend."""

from __future__ import annotations

import importlib
import importlib.util
import math
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from types import ModuleType

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.names import unknown
from econgs_bench.econgs.splat.low_pass import LINEAGE, LowPass
from econgs_bench.econgs.splat.splats import Splats

BACKENDS = ("native", "gsplat", "torch")
_trusted: ContextVar[bool] = ContextVar("trusted", default=False)


@dataclass(frozen=True)
class SplatImages:
    """Results of :func:`rasterise`.

    Attributes:
        features: (H, W, C) sum of weight × feature: premultiplied, without background.
        alpha: (H, W) sum of the weights, in [0, 1].
        depth: (H, W) sum of weight × depth along the optical axis (divide by ``alpha`` for a mean depth).
        radii: (N,) int32, ⌈3 σ⌉ of the longer axis in pixels; 0 where a Gaussian touches no pixel.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor


def rasterise(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    *,
    screen_offset: Tensor | None = None,
    low_pass: LowPass = LINEAGE,
    backend: str | None = None,
) -> SplatImages:
    """Splat N Gaussians with C feature channels into one view (Kerbl et al. 2023, with EWA projection).

    All tensors share one floating dtype and device. Outputs but ``radii`` are differentiable with respect to
    every tensor. Gradients treat skipped contributions (alpha under 1/255, pixels that ended, Gaussians
    nearer than the camera's near plane) and an alpha clamped at 0.99 as constants.

    Args:
        means: (N, 3) centres in scene space.
        quats: (N, 4) rotations (w, x, y, z), of any length but zero; normalised inside.
        scales: (N, 3) standard deviations along the rotated axes, ≥ 0.
        opacities: (N,) in [0, 1].
        features: (N, C), C ≥ 1: colors, normals, anything that blends.
        camera: the view; Gaussians of at most the depth of its near plane are culled.
        screen_offset: (N, 2) added to the projected centres, in pixels; its gradient is the screen-space
            gradient that densification reads.
        low_pass: filters of the Gaussians.
        backend: "native" (CPU, float32), "gsplat" (CUDA, float32) or "torch"; by default the environment
            variable ``ECONGS_BACKEND``, else the one that suits the tensors.

    Raises:
        ValueError: a wrong shape, dtype or device, NaN or infinity, a zero quaternion, a negative scale or an
            opacity outside [0, 1]; the message names the tensor and the first bad index.
        econgs_bench.datasets.errors.UnknownName: no backend of that name.
    """
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    if screen_offset is not None:
        tensors["screen_offset"] = screen_offset
    _check_shapes(tensors)
    _check_camera(camera)
    checked = not values_trusted()
    if low_pass.smoothing:
        if checked:
            _refuse_negative(scales)  # which squares hide
        scales = tensors["scales"] = torch.hypot(scales, scales.new_tensor(math.sqrt(low_pass.smoothing)))
    if (points := low_pass.points) > 1:
        width, height = camera.width, camera.height
        camera, low_pass = camera.resized(points * width, points * height), low_pass.at_points()
        if screen_offset is not None:
            screen_offset = screen_offset * points
    name = choose_backend(means, backend)
    if name != "native" and checked:  # the native kernels check values as they read them
        _check_values(tensors)
    try:
        images = _module(name).rasterise(
            Splats(means, quats, scales, opacities, features, camera, screen_offset, low_pass)
        )
    except ValueError:
        _find_bad(tensors)  # the same message for every backend
        raise
    if points > 1:
        features, alpha, depth = (_pixel_means(one, points) for one in images[:3])
        return SplatImages(features, alpha, depth, -(-images[3] // points))
    return SplatImages(*images)


def _pixel_means(points: Tensor, side: int) -> Tensor:
    """Means (H, W, …) over side × side points of each pixel, of (side · H, side · W, …)."""
    parts = [points[y::side, x::side] for y in range(side) for x in range(side)]
    return sum(parts[1:], start=parts[0]) / len(parts)


def choose_backend(like: Tensor, backend: str | None = None) -> str:
    """Name of the backend: the argument, else ``ECONGS_BACKEND``, else by the tensor's type and device."""
    name = backend or os.environ.get("ECONGS_BACKEND") or None
    if name is not None:
        if name not in BACKENDS:
            raise unknown("backend", name, BACKENDS, of="the splatting core")
        place = {"native": "cpu", "gsplat": "cuda", "torch": like.device.type}[name]
        if name != "torch" and (like.device.type != place or like.dtype != torch.float32):
            raise ValueError(
                f"the {name} backend takes float32 tensors on {place}, not {like.dtype} on {like.device}"
            )
        if name != "torch" and not _present(name):
            remedy = (
                "pip install 'econgs-bench[cuda]'" if name == "gsplat" else "reinstall with a C++17 compiler"
            )
            raise RuntimeError(f"the {name} backend is not installed: {remedy}")
        return name
    suited = {"cpu": "native", "cuda": "gsplat"}.get(like.device.type)
    if suited is None or like.dtype != torch.float32:
        return "torch"
    if not _present(suited):
        _notice(suited)
        return "torch"
    return suited


@contextmanager
def trusted_values() -> Iterator[None]:
    """In this block values are not searched for NaN, infinity and bad ranges; shapes are still checked.

    For loops on a GPU that look at their parameters now and then: every look waits for the device.
    """
    token = _trusted.set(True)
    try:
        yield
    finally:
        _trusted.reset(token)


def values_trusted() -> bool:
    """Whether this is inside :func:`trusted_values`."""
    return _trusted.get()


def native() -> ModuleType:
    """The compiled kernels' module, imported when first used."""
    return _module("native")


def _module(backend: str) -> ModuleType:
    name = backend if backend == "native" else f"{backend}_backend"
    return importlib.import_module(f"econgs_bench.econgs.splat.{name}")


@cache
def _present(backend: str) -> bool:
    module = "econgs_bench.econgs._native" if backend == "native" else backend
    return importlib.util.find_spec(module) is not None


@cache
def _notice(missing: str) -> None:
    """Warn once per process about a slower backend."""
    warnings.warn(
        f"the {missing} splatting backend is not installed; PyTorch stands in, tens of times slower",
        RuntimeWarning,
        stacklevel=4,
    )


def _check_shapes(tensors: dict[str, Tensor]) -> None:
    means = tensors["means"]
    count = means.shape[0] if means.ndim else 0
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "screen_offset": (2,)}
    for name, tensor in tensors.items():
        tail = tuple(tensor.shape[1:])
        fits = len(tail) == 1 and tail[0] >= 1 if name == "features" else tail == shapes[name]
        if tensor.ndim == 0 or tensor.shape[0] != count or not fits:
            size = ", ".join(str(n) for n in (count, *shapes.get(name, ("C ≥ 1",))))
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, not ({size}), for {count} means")
        if not tensor.dtype.is_floating_point or tensor.dtype != means.dtype:
            raise ValueError(
                f"{name} is {tensor.dtype}; all tensors must share one floating dtype ({means.dtype})"
            )
        if tensor.device != means.device:
            raise ValueError(f"{name} is on {tensor.device} but means is on {means.device}")


def _check_camera(camera: Camera) -> None:
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"camera: image of {camera.width} x {camera.height} pixels")
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, camera.near]
    numbers = [*intrinsics, *camera.camera_to_world.ravel().tolist()]
    if not all(math.isfinite(number) for number in numbers) or camera.fx <= 0 or camera.fy <= 0:
        raise ValueError("camera: pose, intrinsics and near plane must be finite and focal lengths positive")


def _check_values(tensors: dict[str, Tensor]) -> None:
    if tensors["means"].shape[0] == 0:
        return
    with torch.no_grad():
        low, high = torch.aminmax(tensors["opacities"])
        length = tensors["quats"].square().sum(-1).amin()
        # A sum is finite only if every term is: one cheap pass per tensor, and one synchronisation for all.
        sums = torch.stack([tensor.sum() for tensor in tensors.values()])
        fine = torch.isfinite(sums).all() & (low >= 0) & (high <= 1)
        fine &= (tensors["scales"].amin() >= 0) & (length > 0)
        if not fine:
            _find_bad(tensors)


def _find_bad(tensors: dict[str, Tensor]) -> None:
    """Raises for the first bad value; returns if a sum merely overflowed."""
    for name, tensor in tensors.items():
        _refuse(name, tensor, ~torch.isfinite(tensor), "every value must be finite")
    opacities, scales, quats = tensors["opacities"], tensors["scales"], tensors["quats"]
    _refuse("opacities", opacities, (opacities < 0) | (opacities > 1), "opacities lie in [0, 1]")
    _refuse_negative(scales)
    _refuse("quats", quats, quats.square().sum(-1) == 0, "a zero quaternion is no rotation")


def _refuse_negative(scales: Tensor) -> None:
    _refuse("scales", scales, scales < 0, "scales are standard deviations, ≥ 0")


def _refuse(name: str, tensor: Tensor, bad: Tensor, rule: str) -> None:
    if bool(bad.any()):
        index = bad.nonzero()[0].tolist()
        value = tensor[tuple(index)].tolist()
        raise ValueError(f"{name}{index} is {value}: {rule}")
