"""Every backend and instruction set that is present, against the float64 oracle; and what they refuse."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import UnknownName
from econgs_bench.econgs.splat import LowPass, choose_backend, rasterise, trusted_values

SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "dense": {"count": 600, "sigma": 0.08, "opacity": (0.4, 1.0)},
    "sparse": {"count": 20, "sigma": 0.02},
    "large": {"count": 150, "sigma": 0.3, "opacity": (0.02, 0.3)},
    "needles": {"stretch": 0.8, "count": 150},
    "off-centre": {"shift": 11.0, "size": (75, 38)},
    "tiles": {"size": (64, 48)},
    "one-channel": {"channels": 1, "size": (17, 16)},
    "four-channels": {"channels": 4, "size": (33, 31)},
    "seven-channels": {"channels": 7},
    "many-channels": {"channels": 35},
    "near": {"position": (0.3, 0.4, 0.3), "fov": 1.2, "count": 120},
    "one-pixel": {"size": (1, 1), "count": 60, "sigma": 0.1},
    "narrow-filter": {"low_pass": LowPass(0.05), "sigma": 0.02},
    "compensated": {"low_pass": LowPass(0.1, compensated=True), "sigma": 0.02, "opacity": (0.3, 1.0)},
    "rays": {"low_pass": LowPass(ray_power=0.5), "stretch": 0.8, "sigma": 0.03},
    "rays-near": {"low_pass": LowPass(ray_power=1.0), "position": (0.3, 0.4, 0.3), "fov": 1.2, "count": 120},
    "rays-compensated": {
        "low_pass": LowPass(0.1, True, ray_power=0.5),
        "stretch": 0.4,
        "opacity": (0.3, 1.0),
    },
    "compensated-needles": {"low_pass": LowPass(compensated=True), "stretch": 0.8, "count": 150},
}


@pytest.fixture(scope="session")
def oracle(splat: Any) -> Any:
    """Scene, seeds, and the oracle's outputs and gradients: computed once for all backends."""
    cache: dict[Any, Any] = {}

    def get(name: str, backend: str = "") -> Any:
        # gsplat culls before the offset is added, and holds alpha at 0.999: neither is compared.
        cuda = backend == "gsplat"
        key = name, cuda
        if key not in cache:
            offset = 1e-3 if cuda else 1.0
            scene = splat.make_scene(seed=sum(map(ord, name)), offset=offset, **SCENES[name])
            reference = splat.brute_force(scene)
            # Few pixels may be left out: those where rounding decides. All others count in full.
            assert reference.doubtful.mean() < 0.2
            keep = ~(reference.doubtful | reference.clamped) if cuda else ~reference.doubtful
            seeds = splat.random_seeds(scene, keep)
            cache[key] = scene, keep, seeds, *scene.gradients(torch.float64, "torch", seeds)
        return cache[key]

    return get


@pytest.mark.parametrize("name", SCENES)
def test_outputs_and_gradients_match_the_oracle(splat: Any, oracle: Any, backend: Any, name: str) -> None:
    if (backend.name, name) == ("gsplat", "off-centre"):
        pytest.skip("gsplat clamps the Jacobian otherwise where the principal point is off centre")
    scene, keep, seeds, outputs, gradients = oracle(name, backend.name)
    mine, my_gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    keep = torch.from_numpy(keep)
    for output in splat.outputs:
        assert splat.relative(mine[output][keep], outputs[output][keep]) < backend.tolerance, output
    errors = {one: splat.relative(my_gradients[one], gradients[one]) for one in splat.names}
    assert max(errors.values()) < backend.tolerance, errors


@pytest.mark.parametrize("seed", [736, 1, 2])
def test_extreme_needles(splat: Any, backend: Any, seed: int) -> None:
    """Axis ratios of 1:100, whose moments in pixels would cancel."""
    scene = splat.make_scene(150, seed=seed, stretch=1.2, offset=1e-3)
    reference = splat.brute_force(scene)
    seeds = splat.random_seeds(scene, ~(reference.doubtful | reference.clamped))
    _, expected = scene.gradients(torch.float64, "torch", seeds)
    _, actual = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    errors = {one: splat.relative(actual[one], expected[one]) for one in splat.names}
    # torch in float32 keeps the cancelling form of the exponent; the kernels keep well inside the bound.
    bound = {"native": 0.3, "torch": 2.0}.get(backend.name, 10.0) * backend.tolerance
    assert max(errors.values()) < bound, errors


@pytest.mark.parametrize(("side", "compensated"), [(2, True), (3, False)])
def test_a_pixel_is_the_mean_over_its_points(splat: Any, backend: Any, side: int, compensated: bool) -> None:
    """Against the brute-force renderer where each point is a pixel; gradients against those of float64."""
    scene = splat.make_scene(120, (21, 17), seed=4, offset=1e-3)
    low_pass = LowPass(0.05, compensated, points=side)
    fine = replace(
        scene,
        camera=scene.camera.resized(side * 21, side * 17),
        low_pass=LowPass(0.05, compensated),
        tensors={**scene.tensors, "screen_offset": side * scene.tensors["screen_offset"]},
    )
    reference = splat.brute_force(fine)

    def means(points: Any) -> Any:
        return points.reshape(17, side, 21, side, *points.shape[2:]).mean((1, 3))

    sure = ~(means((reference.doubtful | reference.clamped).astype(float)) > 0)
    assert sure.mean() > 0.5
    mean = replace(scene, low_pass=low_pass)
    seeds = splat.random_seeds(mean, sure)
    _, expected = mean.gradients(torch.float64, "torch", seeds)
    outputs, gradients = mean.gradients(torch.float32, backend.name, seeds, backend.device)
    keep = torch.from_numpy(sure)
    for name in splat.outputs:
        truth = torch.from_numpy(means(getattr(reference, name)))
        assert splat.relative(outputs[name][keep], truth[keep]) < backend.tolerance, name
    errors = {one: splat.relative(gradients[one], expected[one]) for one in splat.names}
    assert max(errors.values()) < backend.tolerance, errors
    radii = mean.render(torch.float32, backend.name, backend.device).radii.cpu()
    whole = fine.render(torch.float32, backend.name, backend.device).radii.cpu()
    assert torch.equal(radii, torch.ceil(whole / side).int())


def test_gradients_through_points_are_those_of_differences(splat: Any) -> None:
    scene = splat.make_scene(8, (5, 4), seed=2, sigma=0.3, offset=1e-3, low_pass=LowPass(0.3, True, points=2))

    def picture(offset: torch.Tensor) -> torch.Tensor:
        moved = replace(scene, tensors={**scene.tensors, "screen_offset": offset})
        return moved.render(torch.float64, "torch").features

    assert torch.autograd.gradcheck(picture, scene.tensors["screen_offset"].clone().requires_grad_(True))


def test_one_point_that_stands_for_several_is_a_filter_of_the_same_variance() -> None:
    """A box of points: the variance of their places and of the filter at each."""
    for side in (1, 2, 3):
        places = (np.arange(side) + 0.5) / side
        expected = places.var() + 0.03 / side**2
        assert LowPass(0.03, True, points=side).at_one_point().variance == pytest.approx(expected)
    for points in (0, 9):
        with pytest.raises(ValueError, match="points along a side"):
            LowPass(points=points)


def test_no_gradient_array_is_trivially_zero(splat: Any, oracle: Any) -> None:
    for name in SCENES:
        *_, gradients = oracle(name)
        assert all(gradients[one].norm() > 0 for one in splat.names), name


def test_radii_match_the_oracle(splat: Any, oracle: Any, backend: Any) -> None:
    scene = oracle("dense", backend.name)[0]
    expected = scene.render(torch.float64, "torch").radii.numpy()
    actual = scene.render(torch.float32, backend.name, backend.device).radii.cpu().numpy()
    assert actual.dtype == np.int32
    # ⌈·⌉ of a value within rounding of a whole number may differ by one, no more and rarely.
    visible = (actual > 0) & (expected > 0)
    assert (visible == (expected > 0)).mean() > 0.97
    assert abs(actual - expected)[visible].max() <= 1
    assert (actual == expected)[visible].mean() > 0.99


def test_order_of_the_input_does_not_matter(splat: Any, oracle: Any, backend: Any) -> None:
    scene = oracle("plain", backend.name)[0]
    shuffle = torch.from_numpy(np.random.default_rng(3).permutation(len(scene.tensors["means"])))
    shuffled = replace(scene, tensors={name: one[shuffle] for name, one in scene.tensors.items()})
    first = scene.render(torch.float32, backend.name, backend.device)
    second = shuffled.render(torch.float32, backend.name, backend.device)
    torch.testing.assert_close(first.features, second.features, rtol=0, atol=1e-6)
    assert torch.equal(first.radii[shuffle.to(first.radii.device)], second.radii)


def test_quaternions_are_normalised_and_their_gradient_is_tangential(oracle: Any, backend: Any) -> None:
    scene, _, seeds, *_ = oracle("plain", backend.name)
    longer = replace(scene, tensors={**scene.tensors, "quats": 4.0 * scene.tensors["quats"]})
    outputs, gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    same, smaller = longer.gradients(torch.float32, backend.name, seeds, backend.device)
    torch.testing.assert_close(outputs["features"], same["features"], rtol=0, atol=2e-6)
    quats = gradients["quats"]
    assert (4.0 * smaller["quats"] - quats).norm() < 20 * backend.tolerance * quats.norm()
    radial = (quats * torch.nn.functional.normalize(scene.tensors["quats"], dim=1)).sum(1)
    assert radial.norm() < 20 * backend.tolerance * quats.norm()


def test_gradients_of_a_single_output_suffice(splat: Any, oracle: Any, backend: Any) -> None:
    """A loss on alpha alone, or depth alone, and inputs of which only some want gradients."""
    scene, _, seeds, *_ = oracle("plain", backend.name)
    for output in splat.outputs:
        results = []
        for dtype, name, device in (
            (torch.float64, "torch", "cpu"),
            (torch.float32, backend.name, backend.device),
        ):
            moved = {one: tensor.to(device, dtype, copy=True) for one, tensor in scene.tensors.items()}
            moved["means"].requires_grad_(True)
            image = getattr(rasterise(camera=scene.camera, backend=name, **moved), output)
            (image * seeds[output].to(image)).sum().backward()
            results.append(moved["means"].grad.double().cpu())
            assert moved["scales"].grad is None
        assert splat.relative(results[1], results[0]) < backend.tolerance


# ------------------------------------------------------------------ degenerate input


def _changed(scene: Any, name: str, rows: Any, value: Any) -> Any:
    tensors = {one: tensor.clone() for one, tensor in scene.tensors.items()}
    tensors[name][rows] = torch.as_tensor(value, dtype=torch.float64)
    return replace(scene, tensors=tensors)


def _empty(scene: Any) -> Any:
    return replace(scene, tensors={name: one[:0] for name, one in scene.tensors.items()})


@pytest.mark.parametrize("case", ["no Gaussians", "all behind", "all beside", "all transparent"])
def test_what_is_not_seen_leaves_background_and_zero_gradients(splat: Any, backend: Any, case: str) -> None:
    scene = splat.make_scene(50)
    camera = scene.camera
    beyond = torch.from_numpy(camera.camera_to_world[:3, :3] @ [0.0, 0.0, -3.0])
    beside = torch.from_numpy(camera.camera_to_world[:3, :3] @ [50.0, 0.0, 0.0])
    scene = {
        "no Gaussians": lambda: _empty(scene),
        "all behind": lambda: _changed(scene, "means", slice(None), scene.tensors["means"] + beyond),
        "all beside": lambda: _changed(scene, "means", slice(None), scene.tensors["means"] + beside),
        "all transparent": lambda: _changed(scene, "opacities", slice(None), 0.003),
    }[case]()
    seeds = splat.random_seeds(scene, np.ones((camera.height, camera.width), bool))
    outputs, gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    assert outputs["features"].shape == (camera.height, camera.width, 3)
    assert all(one.abs().max() == 0 for one in outputs.values())
    for name, one in gradients.items():
        assert one.shape == scene.tensors[name].shape
        assert one.numel() == 0 or one.abs().max() == 0
    assert scene.render(torch.float32, backend.name, backend.device).radii.sum() == 0


def test_zero_scale_is_a_dot_of_the_blur(splat: Any, backend: Any) -> None:
    scene = _changed(splat.make_scene(30), "scales", slice(None), 0.0)
    seeds = splat.random_seeds(scene, ~splat.brute_force(scene).doubtful)
    _, expected = scene.gradients(torch.float64, "torch", seeds)
    outputs, gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    reference = splat.brute_force(scene)
    keep = ~reference.doubtful
    assert outputs["alpha"].max() > 0.1
    np.testing.assert_allclose(outputs["alpha"].numpy()[keep], reference.alpha[keep], atol=1e-4)
    for name in ("means", "opacities", "features", "screen_offset"):
        assert splat.relative(gradients[name], expected[name]) < 3 * backend.tolerance
    # A scale enters squared: at zero it has no slope, nor has the rotation of a point.
    assert gradients["scales"].abs().max() == 0
    assert gradients["quats"].abs().max() == 0


def test_a_huge_gaussian_veils_the_whole_image(splat: Any, backend: Any) -> None:
    scene = _changed(splat.make_scene(30), "scales", 3, 1e3)
    scene = _changed(scene, "opacities", 3, 0.5)
    reference = splat.brute_force(scene)
    seeds = splat.random_seeds(scene, ~reference.doubtful)
    assert reference.alpha.min() > 0.4
    outputs, gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    np.testing.assert_allclose(
        outputs["alpha"].numpy()[~reference.doubtful], reference.alpha[~reference.doubtful], atol=1e-4
    )
    assert all(torch.isfinite(one).all() for one in gradients.values())


@pytest.mark.parametrize("scale", [1e10, 1e30])
def test_an_absurd_scale_never_makes_a_number_infinite(splat: Any, backend: Any, scale: float) -> None:
    scene = _changed(splat.make_scene(30), "scales", 3, [scale, 0.1, scale])
    seeds = splat.random_seeds(scene, np.ones((scene.camera.height, scene.camera.width), bool))
    outputs, gradients = scene.gradients(torch.float32, backend.name, seeds, backend.device)
    assert all(torch.isfinite(one).all() for one in [*outputs.values(), *gradients.values()])


def test_the_near_plane_culls(splat: Any, backend: Any) -> None:
    scene = splat.make_scene(80)
    depths = (scene.tensors["means"].numpy() - scene.camera.position) @ scene.camera.camera_to_world[:3, 2]
    cut = float(np.median(depths)) + 1e-5
    scene = replace(scene, camera=replace(scene.camera, near=cut))
    radii = scene.render(torch.float32, backend.name, backend.device).radii.cpu().numpy()
    assert (radii[depths < cut - 1e-4] == 0).all()
    assert (radii[depths > cut + 1e-4] > 0).any()


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "features", "screen_offset"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_refused_by_name(splat: Any, backend: Any, name: str, value: float) -> None:
    scene = _changed(splat.make_scene(40), name, 17, value)
    with pytest.raises(ValueError, match=rf"^{name}\[17(, 0)?\] is .*finite"):
        scene.render(torch.float32, backend.name, backend.device)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", 0.0, r"quats\[17\] is .*zero quaternion"),
        ("scales", -1e-6, r"scales\[17, 0\] is .*≥ 0"),
        ("opacities", 1.001, r"opacities\[17\] is .*\[0, 1\]"),
        ("opacities", -0.1, r"opacities\[17\] is .*\[0, 1\]"),
    ],
)
def test_what_has_no_meaning_is_refused_by_name(
    splat: Any, backend: Any, name: str, value: float, message: str
) -> None:
    scene = _changed(splat.make_scene(40), name, 17, value)
    with pytest.raises(ValueError, match=message):
        scene.render(torch.float32, backend.name, backend.device)


def test_trusted_values_are_not_looked_at_but_shapes_are(splat: Any) -> None:
    bad = _changed(splat.make_scene(40), "features", 17, float("nan"))
    with trusted_values():
        assert not torch.isfinite(bad.render(torch.float32, "torch").features).all()
        with pytest.raises(ValueError, match="shape"):
            rasterise(camera=bad.camera, **(bad.tensors | {"quats": bad.tensors["quats"][:, :3]}))
    with pytest.raises(ValueError, match=r"features\[17"):
        bad.render(torch.float32, "torch")


def test_a_sum_that_overflows_is_no_reason_to_refuse(splat: Any) -> None:
    scene = _changed(splat.make_scene(40), "features", slice(None), 3e38)
    assert torch.isfinite(scene.render(torch.float32, "torch").alpha).all()


def test_shapes_dtypes_and_cameras_are_checked(splat: Any) -> None:
    scene = splat.make_scene(10)
    good = scene.tensors
    for name, wrong in {
        "quats": good["quats"][:, :3],
        "scales": good["scales"][:5],
        "opacities": good["opacities"][:, None],
        "features": good["features"][:, 0],
        "screen_offset": good["screen_offset"].float(),
    }.items():
        with pytest.raises(ValueError, match=name):
            rasterise(camera=scene.camera, **{**good, name: wrong})
    with pytest.raises(ValueError, match="features"):
        rasterise(camera=scene.camera, **{**good, "features": good["features"][:, :0]})
    for bad in ({"width": 0}, {"fx": -1.0}, {"cx": float("nan")}):
        with pytest.raises(ValueError, match="camera"):
            rasterise(camera=replace(scene.camera, **bad), **good)


# ------------------------------------------------------------------ choosing a backend


def test_the_backend_suits_the_tensors(splat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ECONGS_BACKEND", raising=False)
    assert choose_backend(torch.zeros(1, dtype=torch.float64)) == "torch"
    if splat.native is not None:
        assert choose_backend(torch.zeros(1)) == "native"
    assert choose_backend(torch.zeros(1), "torch") == "torch"
    monkeypatch.setenv("ECONGS_BACKEND", "torch")
    assert choose_backend(torch.zeros(1)) == "torch"
    monkeypatch.setenv("ECONGS_BACKEND", "pytorch")
    with pytest.raises(UnknownName, match="torch"):
        choose_backend(torch.zeros(1))
    for name in ("native", "gsplat"):
        with pytest.raises(ValueError, match=f"the {name} backend takes float32"):
            choose_backend(torch.zeros(1, dtype=torch.float64), name)


def test_without_the_compiled_module_torch_stands_in_and_says_so_once() -> None:
    program = """
import importlib.util, warnings
find = importlib.util.find_spec
native = "econgs_bench.econgs._native"
importlib.util.find_spec = lambda name, *rest: None if name == native else find(name, *rest)
import torch
from econgs_bench.econgs.splat import choose_backend
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(choose_backend(torch.zeros(1)), choose_backend(torch.zeros(1)), len(caught), caught[0].message)
"""
    environment = {name: value for name, value in os.environ.items() if name != "ECONGS_BACKEND"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, encoding="utf-8", env=environment, check=True
    )
    assert done.stdout.startswith("torch torch 1 the native splatting backend is not installed")
