"""Lights, volumes, cameras and marchers for the tests of the ground truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import look_at_origin, training_cameras
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.ground_truth.model import MarchSettings
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import Light
from econgs_bench.datasets.volume import Volume

HEAD = Light()
FIXED = Light(direction=(0.6, 0.0, 0.8), ambient=0.2, diffuse=0.6, specular=0.3, shininess=12.5)
PHONG = Light(ambient=0.3, diffuse=0.5, specular=0.4, shininess=8.0, model="phong")


def volume(values, spacing=(1.0, 1.0, 1.0), **more):
    return Volume("v", np.asarray(values, dtype=np.float32), spacing, (0.0, 1.0), "made here", **more)


def noise(shape, sigma, seed=0):
    field = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), sigma, mode="wrap")
    return (field - field.min()) / np.ptp(field)


def camera_at(position, size=33, fov=0.5):
    return Camera.with_fov(look_at_origin(np.asarray(position, dtype=float)), fov, size, size)


def around(v, size=64, n=12, pick=(0, 5)):
    cameras = training_cameras(n, 0.5 * float(np.linalg.norm(v.extent)), size, size)
    return tuple(cameras[i] for i in pick)


def mitsuba(v, settings=MarchSettings(), **options):  # noqa: B008
    backend = probe.find_backend()
    if backend.name == "none":
        pytest.fail(f"Mitsuba has no backend: {backend.reason}. {probe.REMEDY}")
    probe.activate(backend)
    from econgs_bench.datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    return MitsubaMarcher(v, settings, **options)


def errors(layers):
    """(n, height, width) largest differences of Mitsuba from the oracle; bricks must not change a picture."""
    volumes = [layer.volume for layer in layers]
    cameras = around(volumes[0], size=48)
    image = mitsuba(volumes).compose(cameras, layers)
    oracle = ReferenceMarcher(volumes)
    exact = np.stack([oracle.compose_exact(c, layers).numpy() for c in cameras])
    assert exact[..., 3].max() > 0.5
    np.testing.assert_array_equal(image, mitsuba(volumes, leap=False).compose(cameras, layers))
    return np.abs(image - exact).max(axis=-1)


def decibels(a, b):
    """PSNR over all values: red, green, blue (premultiplied) and alpha."""
    return float(-10.0 * np.log10(np.mean((a.astype(np.float64) - b) ** 2)))


def kernels(draw):
    """Hashes of the kernels that a drawing launches."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        draw()
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}
