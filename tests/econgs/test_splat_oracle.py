"""The oracle itself, against numpy without tiles, closed forms and finite differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.splat import LINEAGE, LowPass, rasterise
from econgs_bench.econgs.splat.torch_backend import project, ray_factors

SCENES = {
    "plain": {},
    "dense": {"count": 500, "sigma": 0.08, "opacity": (0.5, 1.0)},
    "needles": {"stretch": 1.5, "channels": 1},
    "off-centre": {"shift": 9.0, "size": (50, 33), "channels": 7},
    "wide and near": {"position": (0.3, 0.4, 0.2), "fov": 1.6, "channels": 4},
    "tiny": {"sigma": 0.001, "size": (16, 16)},
    "narrow filter": {"low_pass": LowPass(0.05), "sigma": 0.01},
    "compensated": {"low_pass": LowPass(0.1, compensated=True), "sigma": 0.03, "opacity": (0.5, 1.0)},
    "rays": {"low_pass": LowPass(ray_power=0.5), "stretch": 1.0, "position": (0.3, 0.4, 0.2), "fov": 1.6},
    "rays, compensated": {"low_pass": LowPass(0.1, True, ray_power=1.0), "opacity": (0.5, 1.0), "shift": 9.0},
}


@pytest.mark.parametrize("name", SCENES)
def test_the_oracle_is_the_definition_pixel_by_pixel(splat: Any, name: str) -> None:
    scene = splat.make_scene(seed=len(name), **SCENES[name])
    expected = splat.brute_force(scene)
    actual = scene.render(torch.float64, "torch")
    assert expected.alpha.max() > 0.3
    np.testing.assert_allclose(actual.features.numpy(), expected.features, atol=1e-11)
    np.testing.assert_allclose(actual.alpha.numpy(), expected.alpha, atol=1e-11)
    np.testing.assert_allclose(actual.depth.numpy(), expected.depth, atol=1e-11)
    # A Gaussian whose box holds a pixel but whose ellipse does not counts as touching: radii may only add.
    touched = expected.radii > 0
    np.testing.assert_array_equal(actual.radii.numpy()[touched], expected.radii[touched])


def test_scenes_reach_every_rule(splat: Any) -> None:
    """The scenes above would be no test if no pixel ended and no alpha were held."""
    dense = splat.make_scene(seed=5, **SCENES["dense"])
    assert splat.brute_force(dense).alpha.max() > 0.999
    near = splat.make_scene(seed=13, **SCENES["wide and near"])
    camera = near.camera
    local = (near.tensors["means"].numpy() - camera.position) @ camera.camera_to_world[:3, :3]
    assert (local[:, 2] <= 0.2).any()
    in_front = local[local[:, 2] > 0.2]
    assert (abs(in_front[:, 0] / in_front[:, 2]) > 1.3 * camera.width / 2 / camera.fx).any()


@pytest.mark.parametrize("low_pass", [LINEAGE, LowPass(0.8, compensated=True), LowPass(ray_power=0.7)])
def test_gradients_are_those_of_finite_differences(splat: Any, low_pass: LowPass) -> None:
    scene = splat.make_scene(7, (9, 7), 2, seed=2, sigma=0.15, opacity=(0.3, 0.7), shift=1.0)
    inputs = [one.clone().requires_grad_(True) for one in scene.tensors.values()]

    def render(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        named = dict(zip(scene.tensors, tensors, strict=True))
        out = rasterise(camera=scene.camera, low_pass=low_pass, **named)
        return out.features, out.alpha, out.depth

    assert torch.autograd.gradcheck(render, inputs, eps=1e-7, atol=1e-6, rtol=1e-5)


def test_gradients_reach_gaussians_whose_jacobian_is_clamped(splat: Any) -> None:
    """Far outside the image x/z is held, but depth still moves the Jacobian."""
    camera = Camera.with_fov(np.eye(4), 0.5, 16, 16)
    tensors = [
        torch.tensor([[0.9, 0.1, 1.5]], dtype=torch.float64),
        torch.tensor([[0.8, 0.1, 0.5, -0.3]], dtype=torch.float64),
        torch.tensor([[0.3, 0.5, 0.4]], dtype=torch.float64),
        torch.tensor([0.8], dtype=torch.float64),
        torch.tensor([[1.0]], dtype=torch.float64),
    ]
    assert tensors[0][0, 0] / tensors[0][0, 2] > 1.3 * 8 / camera.fx
    inputs = [one.requires_grad_(True) for one in tensors]
    images = rasterise(*inputs, camera)
    assert images.alpha.max() > 0.1
    check = torch.autograd.gradcheck(
        lambda *all: rasterise(*all, camera).features, inputs, eps=1e-7, atol=1e-6
    )
    assert check


def test_one_gaussian_is_a_closed_form(backend: Any) -> None:
    """On the optical axis an isotropic Gaussian of scale s at depth z has variance (f s / z)² + 0.3."""
    size, depth, scale, opacity = 40, 2.0, 0.1, 0.8
    camera = Camera.with_fov(np.eye(4), 0.6, size, size)
    kind = {"dtype": torch.float32, "device": backend.device}
    out = rasterise(
        torch.tensor([[0.0, 0.0, depth]], **kind),
        torch.tensor([[0.3, 0.5, -0.2, 0.9]], **kind),
        torch.full((1, 3), scale, **kind),
        torch.tensor([opacity], **kind),
        torch.tensor([[2.0, -1.0]], **kind),
        camera,
        backend=backend.name,
    )
    x = np.arange(size) + 0.5 - size / 2
    variance = (camera.fx * scale / depth) ** 2 + 0.3
    alpha = opacity * np.exp(-0.5 * (x[None] ** 2 + x[:, None] ** 2) / variance)
    alpha[alpha < 1 / 255] = 0
    tolerance = {"rtol": 0, "atol": max(2e-6, backend.tolerance)}
    np.testing.assert_allclose(out.alpha.cpu().numpy(), alpha, **tolerance)
    np.testing.assert_allclose(out.depth.cpu().numpy(), alpha * depth, **tolerance)
    np.testing.assert_allclose(out.features.cpu().numpy(), alpha[..., None] * [2.0, -1.0], **tolerance)


@pytest.mark.parametrize("number", [0.0, -0.1, float("nan"), float("inf")])
def test_a_filter_without_a_width_is_refused(number: float) -> None:
    with pytest.raises(ValueError, match="variance"):
        LowPass(number)
    if number:
        with pytest.raises(ValueError, match="smoothing"):
            LowPass(smoothing=number)
        with pytest.raises(ValueError, match="power"):
            LowPass(ray_power=number)


def test_smoothing_adds_to_the_covariance_in_the_scene(splat: Any, backend: Any) -> None:
    """So a scene of balls is the scene of balls that are larger by it."""
    balls = splat.make_scene(60, stretch=0.0, sigma=0.03)
    larger = replace(balls, tensors={**balls.tensors, "scales": (balls.tensors["scales"] ** 2 + 4e-4).sqrt()})
    smooth = replace(balls, low_pass=LowPass(smoothing=4e-4))
    first, second = (one.render(torch.float32, backend.name, backend.device) for one in (larger, smooth))
    torch.testing.assert_close(first.features, second.features, rtol=0, atol=1e-5)
    assert (
        first.features - balls.render(torch.float32, backend.name, backend.device).features
    ).abs().max() > 0.05


def test_smoothing_hides_no_bad_scale_and_overflows_at_none(splat: Any, backend: Any) -> None:
    scene = replace(splat.make_scene(20), low_pass=LowPass(smoothing=1e-4))
    for value, fine in ((1e30, True), (-0.1, False), (float("nan"), False)):
        scales = scene.tensors["scales"].clone()
        scales[3, 1] = value
        changed = replace(scene, tensors={**scene.tensors, "scales": scales})
        if fine:
            assert torch.isfinite(changed.render(torch.float32, backend.name, backend.device).features).all()
        else:
            with pytest.raises(ValueError, match=r"^scales\[3, 1\] is"):
                changed.render(torch.float32, backend.name, backend.device)


def test_a_compensated_gaussian_keeps_its_mass(backend: Any) -> None:
    """Its sum over pixels is 2π opacity · variance before the filter, whatever the filter adds."""
    size, depth, scale, opacity = 60, 2.0, 0.02, 0.8
    camera = Camera.with_fov(np.eye(4), 0.6, size, size)
    kind = {"dtype": torch.float32, "device": backend.device}
    variance = (camera.fx * scale / depth) ** 2
    for low_pass in (LowPass(1.0, compensated=True), LowPass(4.0, compensated=True)):
        alpha = rasterise(
            torch.tensor([[0.0, 0.0, depth]], **kind),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]], **kind),
            torch.full((1, 3), scale, **kind),
            torch.tensor([opacity], **kind),
            torch.ones((1, 1), **kind),
            camera,
            low_pass=low_pass,
            backend=backend.name,
        ).alpha
        cut = 2.0 * np.pi * (variance + low_pass.variance) / 255.0  # of the mass, beyond alpha 1/255
        assert alpha.sum().item() == pytest.approx(2.0 * np.pi * opacity * variance - cut, rel=0.02)


def test_a_sheet_is_darker_edge_on(backend: Any) -> None:
    """By the area across the ray: a disk of radius r and thickness t is r / t times as deep."""
    kind = {"dtype": torch.float32, "device": backend.device}
    camera = Camera.with_fov(np.eye(4), 0.6, 65, 65)

    def middle(quat: tuple[float, ...], power: float) -> float:
        out = rasterise(
            torch.tensor([[0.0, 0.0, 2.0]], **kind),
            torch.tensor([quat], **kind),
            torch.tensor([[0.2, 0.2, 0.05]], **kind),
            torch.tensor([0.3], **kind),
            torch.ones((1, 1), **kind),
            camera,
            low_pass=LowPass(1e-4, ray_power=power),
            backend=backend.name,
        )
        return float(out.alpha[32, 32])

    for power in (0.0, 0.5, 1.0):
        face, edge = middle((1.0, 0.0, 0.0, 0.0), power), middle((0.5**0.5, 0.5**0.5, 0.0, 0.0), power)
        front, side = 0.2 * 0.2, 0.2 * 0.05
        mean = ((front**2 + 2 * side**2) / 3) ** 0.5
        assert face == pytest.approx(1 - 0.7 ** ((mean / front) ** power), abs=1e-4)
        assert edge == pytest.approx(1 - 0.7 ** ((mean / side) ** power), abs=1e-4)


def test_a_gaussian_without_thickness_has_finite_gradients(splat: Any, backend: Any) -> None:
    scene = splat.make_scene(30, sigma=0.1, opacity=(0.3, 0.7))
    for flat in ([2], [1, 2], [0, 1, 2]):
        leaves = {
            name: one.to(torch.float32).to(backend.device).clone() for name, one in scene.tensors.items()
        }
        leaves["scales"][:, flat] = 0.0
        for one in leaves.values():
            one.requires_grad_(True)
        out = rasterise(camera=scene.camera, low_pass=LowPass(ray_power=0.5), backend=backend.name, **leaves)
        (out.features.sum() + out.alpha.sum()).backward()
        assert out.alpha.max() > 0.0
        for name, one in leaves.items():
            assert torch.isfinite(one.grad).all(), (name, flat)


def test_ray_factors_are_those_of_the_projection(splat: Any) -> None:
    scene = splat.make_scene(200, stretch=1.0, position=(0.3, 0.4, 0.3), fov=1.2)  # some rays are clamped
    means, quats, scales = (scene.tensors[name] for name in ("means", "quats", "scales"))
    projected = project(means, quats, scales, scene.camera, None, LowPass(ray_power=0.6))
    torch.testing.assert_close(ray_factors(means, quats, scales, scene.camera, 0.6), projected.ray)
