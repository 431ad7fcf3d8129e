"""The compiled kernels themselves: instruction sets, threads, forks, and what only a direct call can show."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import UnknownName
from econgs_bench.econgs.splat.splats import Splats

from .conftest import ISAS

native = pytest.importorskip(
    "econgs_bench.econgs.splat.native", reason="econgs_bench.econgs._native is not compiled here"
)


def camera() -> Camera:
    pose = np.eye(4)
    pose[2, 3] = -2.0
    return Camera.with_fov(pose, 0.6, 75, 51)


def cloud(count: int = 3000) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    return [
        torch.rand(count, 3, generator=random) - 0.5,
        torch.randn(count, 4, generator=random),
        0.02 * torch.exp(0.5 * torch.randn(count, 3, generator=random)),
        torch.rand(count, generator=random),
        torch.rand(count, 3, generator=random),
    ]


def everything() -> list[torch.Tensor]:
    """Outputs and gradients of the kernels on one scene."""
    leaves = [one.requires_grad_(True) for one in cloud()]
    offset = torch.zeros(len(leaves[0]), 2, requires_grad=True)
    image, alpha, depth, radii = native.rasterise(Splats(*leaves, camera(), screen_offset=offset))
    target = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
    loss = native.photometric_loss(image, target, 0.2) + (alpha * alpha).mean() + depth.mean()
    grads = torch.autograd.grad(loss, [*leaves, offset])
    return [image.detach(), alpha.detach(), depth.detach(), radii, loss.detach(), *grads]


def test_bit_identical_for_any_number_of_threads(isa: str) -> None:
    native.set_threads(1)
    expected = everything()
    assert expected[1].max() > 0.5
    for count in (2, 3, 7):
        native.set_threads(count)
        for mine, theirs in zip(everything(), expected, strict=True):
            assert torch.equal(mine, theirs)


def digest() -> str:
    """A digest of one frame, by the native kernels alone: torch's own threads do not survive a fork."""
    image, *_ = native.rasterise(Splats(*cloud(500), camera()))
    return hashlib.sha256(image.numpy().tobytes()).hexdigest()


def _in_fork(queue: Any) -> None:
    torch.set_num_threads(1)
    queue.put(digest())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_survives_a_fork(restored: None) -> None:
    native.set_threads(2)
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
    code = "from econgs_bench.econgs.splat import native; print(native.isa(), native.threads())"
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, encoding="utf-8"
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


@pytest.mark.parametrize("scale", [0.0, 1e6, 1e30])
def test_extreme_scales_give_finite_numbers(isa: str, scale: float) -> None:
    leaves = cloud(50)
    leaves[2][::3, 0] = scale
    for one in leaves:
        one.requires_grad_(True)
    image, alpha, depth, _ = native.rasterise(Splats(*leaves, camera()))
    (image.sum() + alpha.sum() + depth.sum()).backward()
    assert torch.isfinite(image).all()
    assert torch.isfinite(alpha).all()
    for one in leaves:
        assert torch.isfinite(one.grad).all()


def test_wrong_shapes_are_refused() -> None:
    tensors = cloud(10)
    with pytest.raises(ValueError, match="quats must have shape"):
        native.rasterise(Splats(tensors[0], tensors[1][:9], *tensors[2:], camera()))


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
        view = Camera.with_fov(np.eye(4), 0.6, 256, 128)  # 128 tiles: none may be left out
        means = np.stack([0 * depth, 0 * depth, depth], 1).astype(np.float32)
        tensors = [means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 1e6), np.full(count, 0.01)]
        inputs = [torch.from_numpy(np.asarray(one, np.float32)) for one in (*tensors, colors)]
        image, *_ = native.rasterise(Splats(*inputs, view))
        passing, expected = 1.0, 0.0
        for n in np.argsort(depth, kind="stable"):
            expected += passing * 0.01 * colors[n, 0]
            passing *= 0.99
        assert image.amin().item() == pytest.approx(expected, rel=2e-5)
        assert image.amax().item() == pytest.approx(expected, rel=2e-5)


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


def test_each_frame_has_its_own_statistics() -> None:
    def numbers(count: int) -> tuple[int, int, float]:
        leaves = [one.requires_grad_(True) for one in cloud(count)]
        image, _, _, radii = native.rasterise(Splats(*leaves, camera()))
        frame = native.statistics(image)
        return int(frame["visible"]), int((radii > 0).sum()), frame["evaluations"]

    with ThreadPoolExecutor(4) as pool:
        for visible, expected, evaluations in pool.map(numbers, [3000, 10] * 20):
            assert visible == expected > 0
            assert evaluations >= visible
    assert native.bench_blend() > 0
