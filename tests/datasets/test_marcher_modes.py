"""Compositions, masks, isosurfaces and depth enhancement: closed forms, and the fast marcher against the oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from datasets.camera import Camera
from datasets.camera_paths import look_at_origin, training_cameras
from datasets.errors import DataError
from datasets.ground_truth import probe
from datasets.ground_truth.model import Layer, MarchSettings
from datasets.ground_truth.occlusion import RADII, bake
from datasets.ground_truth.reference import ReferenceMarcher
from datasets.scene import Isosurface, Light
from datasets.transfer import Bump, TransferFunction
from datasets.volume import Volume

HEAD = Light()
FIXED = Light(direction=(0.6, 0.0, 0.8), ambient=0.2, diffuse=0.6, specular=0.3, shininess=12.5)
PHONG = Light(ambient=0.3, diffuse=0.5, specular=0.4, shininess=8.0, model="phong")


def transfer(*bumps):
    return TransferFunction("t", tuple(Bump("b", *b) for b in bumps))


LOW = transfer((0.3, 0.36, 0.4, 0.45, (0.9, 0.5, 0.1), 0.4))
HIGH = transfer((0.6, 0.65, 0.7, 0.75, (0.1, 0.5, 0.9), 0.6), (0.8, 0.85, 1.0, 1.0, (0.4, 0.9, 0.2), 0.9))
EVERYTHING = transfer((0.0, 0.0, 1.0, 1.0, (0.5, 0.3, 0.7), 0.02))
LEVELS = (Isosurface("a", 0.55, (0.9, 0.5, 0.2), 0.4), Isosurface("b", 0.7, (0.2, 0.6, 0.9), 0.8))


def volume(values, spacing=(1.0, 1.0, 1.0), **more):
    return Volume("v", np.asarray(values, dtype=np.float32), spacing, (0.0, 1.0), "made here", **more)


def noise(shape, sigma, seed=0):
    field = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), sigma, mode="wrap")
    return (field - field.min()) / np.ptp(field)


def camera_at(position, size=33, fov=0.5):
    return Camera.with_fov(look_at_origin(np.asarray(position, dtype=float)), fov, size, size)


def around(v, size=48, pick=(0, 5)):
    cameras = training_cameras(12, 0.5 * float(np.linalg.norm(v.extent)), size, size)
    return tuple(cameras[i] for i in pick)


def mitsuba(v, settings=MarchSettings(), **options):  # noqa: B008
    backend = probe.find_backend()
    if backend.name == "none":
        pytest.fail(f"Mitsuba has no backend: {backend.reason}. {probe.REMEDY}")
    probe.activate(backend)
    from datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    return MitsubaMarcher(v, settings, **options)


@pytest.fixture(params=["reference", "mitsuba"])
def marcher(request):
    return ReferenceMarcher if request.param == "reference" else mitsuba


A = volume(noise((30, 40, 35), 2.5), (1.0, 1.2, 0.9))
B = volume(noise((30, 40, 35), 3.5, seed=1), (1.0, 1.2, 0.9))
BALL = np.linalg.norm(np.moveaxis(np.indices((30, 40, 35)), 0, -1) - (15.0, 20.0, 17.0), axis=-1) < 14.3
MASKED = replace(A, mask=BALL)

SCENES = {
    "composition on one volume": [Layer(A, LOW, HEAD), Layer(A, HIGH, PHONG)],
    "composition on two volumes": [Layer(A, LOW, HEAD), Layer(B, HIGH, FIXED), Layer(A, HIGH, None)],
    "mask": [Layer(MASKED, EVERYTHING, HEAD)],
    "composition with mask": [Layer(MASKED, LOW, FIXED), Layer(B, HIGH, HEAD)],
    "depth-enhanced": [Layer(A, HIGH, HEAD, (), 0.8)],
    "depth-enhanced composition": [Layer(MASKED, LOW, HEAD, (), 0.5), Layer(B, HIGH, FIXED, (), 1.0)],
    "isosurfaces": [Layer(A, None, HEAD, LEVELS)],
    "isosurfaces, phong, masked, enhanced": [Layer(MASKED, None, PHONG, LEVELS, 0.7)],
    "isosurfaces of two volumes and a volume": [
        Layer(A, None, HEAD, LEVELS[:1]),
        Layer(B, None, None, LEVELS[1:]),
        Layer(B, LOW, FIXED),
    ],
}


@pytest.mark.parametrize("name", SCENES)
def test_mitsuba_agrees_with_the_oracle_and_bricks_change_nothing(name):
    layers = SCENES[name]
    volumes = [layer.volume for layer in layers]
    cameras = around(volumes[0])
    image = mitsuba(volumes).compose(cameras, layers)
    oracle = ReferenceMarcher(volumes)
    exact = np.stack([oracle.compose_exact(c, layers).numpy() for c in cameras])
    assert exact[..., 3].max() > 0.5
    error = np.abs(image - exact).max(axis=-1)
    good = np.ones(error.shape, dtype=bool)
    if any(layer.isosurfaces for layer in layers):
        # A ray that grazes a surface may cross it twice, or not at all, by the last bit.
        good = error < 0.02
        assert (~good).mean() < 2e-3
        assert np.sqrt((error**2).mean()) <= 5e-3
    assert np.sqrt((error[good] ** 2).mean()) <= 5e-5
    assert error[good].max() <= 2e-4
    np.testing.assert_array_equal(image, mitsuba(volumes, leap=False).compose(cameras, layers))
