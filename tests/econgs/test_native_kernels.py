"""The compiled kernels themselves: instruction sets, threads, forks, and what only a direct call can show."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from scipy.special import sph_harm_y
from skimage.metrics import structural_similarity

from datasets.camera import Camera
from datasets.errors import UnknownName

native = pytest.importorskip("econgs.splat.native", reason="econgs._native is not compiled here")
ISAS = native.available_isas(testing=True)


@pytest.fixture(params=ISAS)
def isa(request: pytest.FixtureRequest) -> Any:
    before = native.isa()
    native.set_isa(request.param)
    yield request.param
    native.set_isa(before)


@pytest.fixture
def threads() -> Any:
    before = native.threads()
    yield native.set_threads
    native.set_threads(before)


def camera(width: int = 75, height: int = 51) -> Camera:
    pose = np.eye(4)
    pose[2, 3] = -2.0
    return Camera.with_fov(pose, 0.6, width, height)


def cloud(count: int = 3000, channels: int = 3, seed: int = 0) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return [
        torch.rand(count, 3, generator=random) - 0.5,
        torch.randn(count, 4, generator=random),
        0.02 * torch.exp(0.5 * torch.randn(count, 3, generator=random)),
        torch.rand(count, generator=random),
        torch.rand(count, channels, generator=random),
    ]


def everything(seed: int = 0) -> list[torch.Tensor]:
    """Outputs and gradients of the kernels on one scene."""
    leaves = [one.requires_grad_(True) for one in cloud(seed=seed)]
    offset = torch.zeros(len(leaves[0]), 2, requires_grad=True)
    image, alpha, depth, radii = native.rasterise(*leaves, camera(), screen_offset=offset)
    target = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
    loss = native.photometric_loss(image, target, 0.2) + (alpha * alpha).mean() + depth.mean()
    grads = torch.autograd.grad(loss, [*leaves, offset])
    return [image.detach(), alpha.detach(), depth.detach(), radii, loss.detach(), *grads]


def test_bit_identical_for_any_number_of_threads(isa: str, threads: Any) -> None:
    threads(1)
    expected = everything()
    assert expected[1].max() > 0.5
    for count in (2, 3, 7):
        threads(count)
        for mine, theirs in zip(everything(), expected, strict=True):
            assert torch.equal(mine, theirs)


def test_instruction_sets_agree() -> None:
    results = {}
    before = native.isa()
    for name in ISAS:
        native.set_isa(name)
        results[name] = everything()
    native.set_isa(before)
    for name in ISAS:
        for mine, theirs in zip(results[name], results["baseline"], strict=True):
            assert (mine - theirs).double().norm() <= 2e-5 * theirs.double().norm(), name


def digest() -> str:
    """A digest of one frame, by the native kernels alone: torch's own threads do not survive a fork."""
    image, *_ = native.rasterise(*cloud(500), camera())
    return hashlib.sha256(image.numpy().tobytes()).hexdigest()


def _in_fork(queue: Any) -> None:
    torch.set_num_threads(1)
    queue.put(digest())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_survives_a_fork(threads: Any) -> None:
    threads(2)
    expected = digest()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_in_fork, args=(queue,))
    child.start()
    try:
        assert queue.get(timeout=60) == expected
    finally:
        child.join(10)
        child.kill()


def run_with(**environment: str) -> subprocess.CompletedProcess[str]:
    code = "from econgs.splat import native; print(native.isa(), native.threads())"
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True
    )


def test_environment_forces_isa_and_threads() -> None:
    assert run_with(ECONGS_ISA="baseline", ECONGS_THREADS="3").stdout.split() == ["baseline", "3"]


def test_environment_that_cannot_be_met_is_refused() -> None:
    wrong = run_with(ECONGS_ISA="avx3")
    assert wrong.returncode != 0
    assert "instruction set 'avx3'" in wrong.stderr
    assert "avx2" in wrong.stderr
    assert "ECONGS_THREADS" in run_with(ECONGS_THREADS="many").stderr


def test_unknown_instruction_set() -> None:
    with pytest.raises(UnknownName, match="avx"):
        native.set_isa("avx-512")
    missing = set(native._native.built_isas()) - set(ISAS)
    for name in missing:
        with pytest.raises(RuntimeError, match=name):
            native.set_isa(name)


def test_the_16_lane_variant_is_only_for_tests() -> None:
    assert "avx2x16" not in native.available_isas()
    assert native.available_isas()[-1] == "baseline"


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_not_finite_is_refused_by_name(isa: str, place: int, value: float) -> None:
    tensors = cloud(37)
    tensors[place].view(37, -1)[20, -1] = value
    names = ["means", "quats", "scales", "opacities", "features"]
    with pytest.raises(ValueError, match=rf"{names[place]}\[20\]"):
        native.rasterise(*tensors, camera())


def test_out_of_range_is_refused_by_name(isa: str) -> None:
    for place, value, name in [(3, 1.5, "opacities"), (3, -0.1, "opacities"), (2, -1.0, "scales")]:
        tensors = cloud(10)
        tensors[place].view(10, -1)[7] = value
        with pytest.raises(ValueError, match=rf"{name}\[7\]"):
            native.rasterise(*tensors, camera())
    tensors = cloud(10)
    tensors[1][4] = 0
    with pytest.raises(ValueError, match=r"quats\[4\]"):
        native.rasterise(*tensors, camera())


def test_wrong_shapes_are_refused() -> None:
    tensors = cloud(10)
    with pytest.raises(ValueError, match="quats must have shape"):
        native.rasterise(tensors[0], tensors[1][:9], *tensors[2:], camera())


@pytest.mark.parametrize("scale", [0.0, 1e6, 1e30])
def test_extreme_scales_give_finite_numbers(isa: str, scale: float) -> None:
    leaves = cloud(50)
    leaves[2][::3, 0] = scale
    for one in leaves:
        one.requires_grad_(True)
    image, alpha, depth, _ = native.rasterise(*leaves, camera())
    (image.sum() + alpha.sum() + depth.sum()).backward()
    assert torch.isfinite(image).all()
    assert torch.isfinite(alpha).all()
    for one in leaves:
        assert torch.isfinite(one.grad).all()


def test_gradients_by_finite_differences_of_the_oracle() -> None:
    """The oracle in float64 is differentiated numerically: neither its autograd nor ours is trusted."""
    from econgs.splat import torch_backend

    tensors = [one.double() for one in cloud(12, seed=3)]
    tensors[2] += 0.05
    tensors[3] = 0.3 + 0.5 * tensors[3]
    weight = torch.rand(20, 20, 3, generator=torch.Generator().manual_seed(2)).double()
    view = camera(20, 20)

    def value(inputs: list[torch.Tensor]) -> float:
        image, alpha, depth, _ = torch_backend.rasterise(*inputs, view, near=0.2, screen_offset=None)
        return ((image * weight).sum() + alpha.sum() + depth.sum()).item()

    leaves = [one.float().requires_grad_(True) for one in tensors]
    image, alpha, depth, _ = native.rasterise(*leaves, view)
    ((image * weight.float()).sum() + alpha.sum() + depth.sum()).backward()
    generator = torch.Generator().manual_seed(4)
    for place, leaf in enumerate(leaves):
        direction = torch.randn(leaf.shape, generator=generator).double()
        ends = []
        for sign in (1, -1):
            moved = list(tensors)
            moved[place] = tensors[place] + sign * 1e-6 * direction
            ends.append(value(moved))
        slope = (ends[0] - ends[1]) / 2e-6
        # Pixels that cross 1/255 between the two ends jump: loose, but a wrong formula is off by more.
        size = leaf.grad.norm().item() * direction.norm().item()
        assert abs(slope - (leaf.grad.double() * direction).sum().item()) < 2e-2 * size


def test_spherical_harmonics_against_scipy(isa: str) -> None:
    random = np.random.default_rng(0)
    means = random.normal(size=(301, 3)).astype(np.float32)
    coefficients = (0.05 * random.normal(size=(301, 16, 3))).astype(np.float32)
    eye = np.array([0.3, -0.2, 0.1], np.float32)
    d = (means - eye).astype(np.float64)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    basis = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), polar, azimuth)
            part = y.real if order == 0 else np.sqrt(2) * (y.imag if order < 0 else y.real)
            basis.append(part)
    for degree in range(4):
        used = (degree + 1) ** 2
        expected = 0.5 + np.einsum("kn,nkc->nc", np.array(basis[:used]), coefficients[:, :used].astype(float))
        colors = native.spherical_harmonics(
            degree, torch.from_numpy(means), torch.from_numpy(eye), torch.from_numpy(coefficients)
        )
        np.testing.assert_allclose(colors.numpy(), np.maximum(expected, 0), atol=2e-6)


def test_unused_bands_get_zero_gradient(isa: str) -> None:
    means, coefficients = torch.randn(33, 3), torch.randn(33, 16, 3, requires_grad=True)
    native.spherical_harmonics(1, means, torch.zeros(3), coefficients).sum().backward()
    assert coefficients.grad is not None
    assert (coefficients.grad[:, 4:] == 0).all()
    assert (coefficients.grad[:, :4] != 0).any()


@pytest.mark.parametrize("shape", [(32, 40, 3), (23, 37, 1), (17, 13, 4), (5, 3, 3), (1, 1, 3)])
def test_ssim_map_against_float64(isa: str, shape: tuple[int, ...]) -> None:
    random = np.random.default_rng(1)
    x, y = random.random(shape).astype(np.float32), random.random(shape).astype(np.float32)
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def blur(image: Any) -> Any:
        return correlate1d(correlate1d(image, taps, 0, mode="constant"), taps, 1, mode="constant")

    a, b = x.astype(float), y.astype(float)
    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    actual = native.ssim(torch.from_numpy(x), torch.from_numpy(y)).item()
    assert actual == pytest.approx(expected.mean(), abs=2e-6)


def test_ssim_interior_against_scikit_image() -> None:
    """Padding does not matter here: round the random patch lies a constant frame with SSIM 1."""
    random = np.random.default_rng(2)
    x, y = np.full((64, 64, 3), 0.5, np.float32), np.full((64, 64, 3), 0.5, np.float32)
    x[20:44, 20:44], y[20:44, 20:44] = random.random((2, 24, 24, 3))
    _, full = structural_similarity(
        x.astype(float), y.astype(float), channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert native.ssim(torch.from_numpy(x), torch.from_numpy(y)).item() == pytest.approx(
        full.mean(), abs=5e-6
    )


def test_adam_against_torch(isa: str) -> None:
    random = torch.Generator().manual_seed(0)
    shapes = [(7,), (130, 3), (33, 15, 3), (40_001,), (0, 3)]
    mine = [torch.randn(shape, generator=random) for shape in shapes]
    theirs = [one.clone().requires_grad_(True) for one in mine]
    rates = [1e-2, 1e-3, 5e-3, 1e-4, 1.0]
    first, second = [torch.zeros_like(one) for one in mine], [torch.zeros_like(one) for one in mine]
    groups = [{"params": [one], "lr": rate} for one, rate in zip(theirs, rates, strict=True)]
    reference = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 8):
        grads = [torch.randn(shape, generator=random) for shape in shapes]
        grads[2][:, 3:] = 0  # inactive bands
        if step > 3:
            grads[1][:] = 0  # a Gaussian that is not seen goes on moving
        for one, grad in zip(theirs, grads, strict=True):
            one.grad = grad.clone()
        reference.step()
        native.adam_step(mine, grads, first, second, rates, 0.9, 0.999, 1e-15, step)
    start = torch.Generator().manual_seed(0)
    begun = [torch.randn(shape, generator=start) for shape in shapes]
    assert torch.equal(mine[2][:, 3:], begun[2][:, 3:])
    for one, other in zip(mine, theirs, strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=2e-6, atol=2e-7)


def test_adam_moments_are_those_of_float64(isa: str) -> None:
    """1 - 0.999 formed in float32 is 1.3e-5 off, which every second moment would show."""
    grads = torch.randn(1003, generator=torch.Generator().manual_seed(5))
    value, first, second = (torch.zeros(1003) for _ in range(3))
    for step in (1, 2, 3):
        native.adam_step([value], [grads], [first], [second], [1.0], 0.9, 0.999, 1e-15, step)
    exact = grads.double()
    torch.testing.assert_close(second.double(), (1 - 0.999**3) * exact**2, rtol=5e-7, atol=0)
    torch.testing.assert_close(first.double(), (1 - 0.9**3) * exact, rtol=5e-7, atol=0)
    torch.testing.assert_close(value.double(), -3 * exact.sign(), rtol=1e-6, atol=0)


def test_a_tile_is_drawn_near_to_far_whatever_its_number(isa: str) -> None:
    """From few to very many Gaussians a tile, equal depths among them: those of lower index lie in front."""
    for count in (5, 32, 33, 700):
        random = np.random.default_rng(count)
        depth = random.permutation(np.repeat(np.linspace(1.0, 3.0, (count + 1) // 2), 2)[:count])
        colors = random.random((count, 1)).astype(np.float32)
        view = Camera.with_fov(np.eye(4), 0.6, 16, 16)
        means = np.stack([0 * depth, 0 * depth, depth], 1).astype(np.float32)
        tensors = [means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 1e6), np.full(count, 0.01)]
        inputs = [torch.from_numpy(np.asarray(one, np.float32)) for one in (*tensors, colors)]
        image, *_ = native.rasterise(*inputs, view)
        passing, expected = 1.0, 0.0
        for n in np.argsort(depth, kind="stable"):
            expected += passing * 0.01 * colors[n, 0]
            passing *= 0.99
        assert image[8, 8, 0].item() == pytest.approx(expected, rel=2e-5)


def test_adam_refuses_what_does_not_fit() -> None:
    four = [torch.zeros(4)]
    with pytest.raises(ValueError, match="another size"):
        native.adam_step(four, [torch.zeros(3)], four, four, [0.1], 0.9, 0.999, 1e-15, 1)
    with pytest.raises(ValueError, match="contiguous"):
        native.adam_step([torch.zeros(4, 4).T], four, four, four, [0.1], 0.9, 0.999, 1e-15, 1)


def test_denormals_are_left_to_the_caller() -> None:
    """Adam flushes denormals while it works, not for the process."""
    many = [torch.ones(40_000)]
    native.adam_step(many, many, [torch.zeros(40_000)], [torch.zeros(40_000)], [0.1], 0.9, 0.999, 1e-15, 1)
    assert (torch.full((8,), 1e-40) * 0.5).min().item() > 0


def test_timing_hooks_report() -> None:
    everything()
    frame = native.last_frame()
    assert frame["visible"] > 0
    assert frame["evaluations"] >= frame["visible"]
    assert native.bench_blend() > 0
    assert native.bench_blend(backward=True) > 0
