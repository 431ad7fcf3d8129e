"""Both renderers of ground truth against closed forms, and the fast one against the float64 oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import look_at_origin
from econgs_bench.datasets.ground_truth.bricks import BRICK, Bricks
from econgs_bench.datasets.ground_truth.bricks import leaps as leap_distances
from econgs_bench.datasets.ground_truth.model import Layer, MarchSettings
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from tests.datasets import marching
from tests.datasets.marching import FIXED, HEAD, PHONG, around, camera_at, mitsuba, noise, volume

PHONG_FIXED = Light((0.6, 0.0, 0.8), 0.3, 0.5, 0.4, 8.0, "phong")
EVERYTHING = TransferFunction("all", (Bump("all", 0.0, 0.0, 1.0, 1.0, (0.9, 0.4, 0.2), 0.03),))
NARROW = TransferFunction(
    "narrow",
    (
        Bump("a", 0.55, 0.6, 0.6, 0.65, (1.0, 0.3, 0.2), 0.5),
        Bump("b", 0.75, 0.8, 1.0, 1.0, (0.2, 0.4, 1.0), 0.95),
    ),
)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("step", [0.7, 3.0])
def test_transmittance_of_a_homogeneous_box_is_exponential_in_its_depth(marcher, axis, step):
    v = volume(np.full((11, 16, 7), 0.5), spacing=(1.0, 0.5, 2.0))
    position = 5.0 * np.eye(3)[axis]
    image = marcher(v, MarchSettings(step_voxels=step)).render((camera_at(position),), EVERYTHING, None)[0]
    sigma = -np.log(1.0 - 0.03) / EVERYTHING.reference_length
    alpha = 1.0 - np.exp(-sigma * v.extent[axis])
    np.testing.assert_allclose(image[16, 16, 3], alpha, atol=2e-6)
    np.testing.assert_allclose(image[16, 16, :3], alpha * np.array([0.9, 0.4, 0.2]), atol=2e-6)
    assert image[0, 0].max() == 0.0


INSIDE = TransferFunction("t", (Bump("inside", 0.3, 0.3, 0.7, 0.7, (0.8, 0.5, 0.3), 0.2),))


def check_shading(image, light, cosine, facing, atol):
    """Colors under a light, from the cosines of the normal with it and of the highlight."""
    lit, highlight = light.ambient + light.diffuse * np.abs(cosine), light.specular * facing**light.shininess
    expected = np.clip(lit[..., None] * (0.8, 0.5, 0.3) + highlight[..., None], 0.0, 1.0)
    opaque = image[..., 3] > 0.05
    assert opaque.sum() > 20
    np.testing.assert_allclose(image[opaque][:, :3] / image[opaque][:, 3:], expected[opaque], atol=atol)


@pytest.mark.parametrize("light", [Light(ambient=0.1, diffuse=0.6, specular=0.3, shininess=10.0), FIXED])
def test_constant_gradient_gives_blinn_phong_in_closed_form(marcher, light):
    v = volume(np.broadcast_to(np.linspace(0.0, 1.0, 33), (9, 9, 33)))
    camera = camera_at([2.0, -1.5, 1.0], size=21, fov=0.1)  # rays stay clear of the y and z borders' clamping
    direction = camera.rays()[1]
    normal = np.array([1.0, 0.0, 0.0])
    towards = -direction if light.direction is None else np.broadcast_to(light.direction, direction.shape)
    half = towards - direction
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    image = marcher(v).render((camera,), INSIDE, light)[0]
    assert (image[..., 3] > 0.05).sum() > 100
    check_shading(image, light, towards @ normal, np.abs(half @ normal), 2e-4)


@pytest.mark.parametrize("light", [PHONG, replace(PHONG, direction=(0.96, 0.0, 0.28))])
@pytest.mark.parametrize("rising", [True, False])
def test_phong_has_its_highlight_around_the_mirrored_light_on_both_sides(marcher, light, rising):
    """Against the equation in the form of VTK's shader: its normal points inwards, its vectors away."""
    x = np.linspace(0.0, 1.0, 33) if rising else np.linspace(1.0, 0.0, 33)
    camera = camera_at([2.0, -0.4, 0.3], size=21, fov=0.3)
    direction = camera.rays()[1]
    inwards = np.array([1.0 if rising else -1.0, 0.0, 0.0])
    away = direction if light.direction is None else -np.broadcast_to(light.direction, direction.shape)
    cosine = away @ -inwards
    mirrored = 2.0 * cosine[..., None] * inwards + away
    facing = np.maximum((mirrored * -direction).sum(-1), 0.0)
    assert np.ptp(light.specular * facing**light.shininess) > 0.1
    image = marcher(volume(np.broadcast_to(x, (9, 9, 33)))).render((camera,), INSIDE, light)[0]
    check_shading(image, light, cosine, facing, 3e-4)


@pytest.mark.parametrize(("light", "share"), [(PHONG, 0.3), (Light(None, 0.3, 0.4, 0.9), 0.7)])
def test_without_a_gradient_phong_is_ambient_and_blinn_phong_diffuse_too(marcher, light, share):
    v = volume(np.full((9, 9, 9), 0.5))
    image = marcher(v).render((camera_at([4.0, 0.0, 0.0]),), EVERYTHING, light)[0, 16, 16]
    np.testing.assert_allclose(image[:3] / image[3], share * np.array([0.9, 0.4, 0.2]), atol=1e-5)


def test_shaded_color_is_clamped(marcher):
    v = volume(np.broadcast_to(np.linspace(0.0, 1.0, 9), (9, 9, 9)))
    image = marcher(v).render((camera_at([4.0, 0.5, 0.5]),), EVERYTHING, Light(ambient=3.0))[0]
    assert image.max() <= 1.0
    assert (image[..., :3] <= image[..., 3:] + 1e-6).all()


def test_anisotropic_spacing_is_the_same_field_sampled_otherwise(marcher):
    # Linear along y, so that half the samples at twice the distance hold the same field; the visible values
    # stay away from the borders in y, where the clamped gradient depends on the spacing.
    z, y, x = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 33), np.linspace(0, 1, 25), indexing="ij")
    field = 0.2 + 0.6 * y + 0.08 * np.sin(5.0 * x) * np.cos(4.0 * z)
    transfer = TransferFunction("t", (Bump("b", 0.4, 0.45, 0.5, 0.55, (0.8, 0.5, 0.3), 0.3),))
    fine, coarse = volume(field), volume(field[:, ::2], spacing=(1.0, 2.0, 1.0))
    np.testing.assert_allclose(fine.extent, coarse.extent)
    cameras = around(fine)
    for light in (HEAD, FIXED):
        a, b = (marcher(v).render(cameras, transfer, light) for v in (fine, coarse))
        assert a[..., 3].max() > 0.5
        np.testing.assert_allclose(a, b, atol=3e-4)


def test_headlight_and_fixed_light_differ_and_the_headlight_follows_the_camera(marcher):
    v = volume(noise((24, 24, 24), 3.0))
    cameras = around(v)
    head, fixed = (
        marcher(v).render(cameras, NARROW, light) for light in (HEAD, Light(direction=(0.0, 0.0, 1.0)))
    )
    np.testing.assert_array_equal(head[..., 3], fixed[..., 3])
    assert np.abs(head - fixed).max() > 0.1
    # A light fixed at the camera's side of a distant camera is that camera's headlight.
    far = Camera.with_fov(look_at_origin(np.array([0.0, 300.0, 400.0])), 0.004, 32, 32)
    a, b = (marcher(v).render((far,), NARROW, light) for light in (HEAD, Light(direction=(0.0, 0.6, 0.8))))
    assert a[..., 3].max() > 0.5
    np.testing.assert_allclose(a, b, atol=0.02)


def test_smaller_steps_converge():
    v = volume(noise((24, 24, 24), 2.0))
    camera, layers = around(v, pick=(3,))[0], [Layer(v, NARROW, HEAD)]
    images = [
        ReferenceMarcher(v, MarchSettings(step_voxels=s)).compose_exact(camera, layers).numpy()
        for s in (1.0, 0.5, 0.25, 0.03125)
    ]
    errors = [np.sqrt(((i - images[-1]) ** 2).mean()) for i in images[:-1]]
    assert errors[0] > 1.7 * errors[1] > 1.7**2 * errors[2]
    assert errors[2] < 3e-3


def test_the_table_is_fine_enough():
    v = volume(noise((24, 24, 24), 2.0))
    camera, layers = around(v, pick=(3,))[0], [Layer(v, NARROW, HEAD)]
    exact, used, coarse = (
        ReferenceMarcher(v, settings).compose_exact(camera, layers)
        for settings in (MarchSettings(table_size=2**20 + 1), MarchSettings(), MarchSettings(table_size=256))
    )
    assert float((used - exact).abs().max()) < 2e-4
    assert float(((used - exact) ** 2).mean().sqrt()) < 2e-5
    assert float((coarse - exact).abs().max()) > 1e-3


@pytest.mark.parametrize(
    "light",
    [None, HEAD, FIXED, PHONG, PHONG_FIXED],
    ids=["unshaded", "headlight", "fixed", "phong", "phong, fixed"],
)
@pytest.mark.parametrize("transfer", [EVERYTHING, NARROW], ids=["everything", "narrow"])
@pytest.mark.parametrize(
    "v",
    [
        volume(noise((30, 40, 35), 2.5)),
        volume(noise((21, 18, 26), 0.0), spacing=(1.0, 1.6, 0.7)),
        volume(np.rint(255 * noise((40, 25, 30), 1.5)) / 255, spacing=(2.0, 1.0, 1.0)),
    ],
    ids=["smooth", "white noise", "8-bit"],
)
def test_mitsuba_agrees_with_the_oracle_and_bricks_change_nothing(v, transfer, light):
    error = marching.errors([Layer(v, transfer, light)])
    assert np.sqrt((error**2).mean()) <= 5e-5
    assert error.max() <= 2e-4


def test_reference_in_float32_agrees_with_float64():
    v = volume(noise((30, 40, 35), 2.5))
    cameras = around(v, size=48)
    single = ReferenceMarcher(v, dtype=torch.float32).render(cameras, NARROW, HEAD)
    np.testing.assert_allclose(single, ReferenceMarcher(v).render(cameras, NARROW, HEAD), atol=2e-3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_reference_on_cuda_agrees_with_the_cpu():
    v = volume(noise((30, 40, 35), 2.5))
    surface = Isosurface("half", 0.5, (0.2, 0.5, 0.9), 0.4)
    layers = [Layer(v, NARROW, PHONG, depth_enhancement=0.5), Layer(v, None, FIXED, (surface,))]
    here, there = (
        ReferenceMarcher(v, device=device).prepare(layers)(around(v, size=48)) for device in ("cpu", "cuda")
    )
    np.testing.assert_allclose(there, here, atol=1e-6)


def test_views_of_one_launch_equal_views_rendered_alone_and_may_start_inside_the_box():
    v = volume(noise((24, 24, 24), 2.0))
    inside = Camera.with_fov(look_at_origin(np.array([0.1, 0.05, 0.2])), 1.0, 40, 40)
    beside = Camera.with_fov(
        look_at_origin(np.array([0.1, 0.05, 0.2])) @ np.diag([1, -1, -1, 1]), 1.0, 40, 40
    )
    axis = Camera.with_fov(look_at_origin(np.array([0.0, 0.0, 4.0])), 0.4, 40, 40)
    cameras = (inside, beside, axis)
    fast = mitsuba(v)
    together = fast.render(cameras, NARROW, HEAD)
    alone = np.concatenate([fast.render((c,), NARROW, HEAD) for c in cameras])
    np.testing.assert_array_equal(together, alone)
    np.testing.assert_allclose(together, ReferenceMarcher(v).render(cameras, NARROW, HEAD), atol=2e-4)


def test_no_view_light_or_transfer_function_compiles_again():
    fast = mitsuba(volume(noise((24, 30, 26), 2.0)))

    def launched(size, transfer, light, pick):
        cameras = around(volume(np.zeros((24, 30, 26))), size=size, pick=pick)
        return marching.kernels(lambda: fast.render(cameras, transfer, light))

    first = launched(32, NARROW, HEAD, (0, 1))
    assert first
    assert launched(32, EVERYTHING, HEAD, (4, 7)) <= first
    assert launched(32, NARROW, FIXED, (0, 1, 2)) <= first
    assert launched(40, NARROW, Light(specular=0.9, shininess=3.0), (2,)) <= first


def test_leaps_never_skip_what_a_brute_force_search_finds_visible():
    values = noise((41, 60, 33), 4.0).astype(np.float32)
    values[:, 26:] *= 0.5  # nothing to see there
    extinction = NARROW.table(4096)[:, 3]
    bricks = Bricks(values.shape)
    assert sum(1 for _ in bricks.passing(values)) == len(values)
    leaps = leap_distances(bricks.empty(extinction))
    z, y, x = (np.arange(0.0, n - 1 + 1e-9, 0.5) for n in values.shape)
    grid = np.stack(np.meshgrid(z, y, x, indexing="ij"), axis=-1).reshape(-1, 3)
    from scipy.ndimage import map_coordinates

    sampled = map_coordinates(values, grid.T, order=1, mode="nearest")
    visible = np.interp(sampled, np.linspace(0, 1, len(extinction)), extinction) > 0
    bricks = np.minimum((grid // BRICK).astype(int), np.array(leaps.shape) - 1)
    opaque = np.unique(bricks[visible], axis=0)
    assert 0 < len(opaque) < leaps.size
    for index in np.ndindex(leaps.shape):
        nearest = np.abs(opaque - index).max(axis=1).min()
        assert leaps[index] <= nearest
    assert leaps.max() > 1


def test_an_invisible_volume_is_empty(marcher):
    invisible = TransferFunction("t", (Bump("b", 0.9, 0.95, 0.95, 1.0, (1.0, 1.0, 1.0), 0.5),))
    image = marcher(volume(np.linspace(0.0, 0.5, 1000).reshape(10, 10, 10))).render(
        (camera_at([3.0, 1.0, 1.0]),), invisible, HEAD
    )
    assert not image.any()
