"""The photometric loss against scikit-image, the usual convolution and finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from econgs_bench.econgs.losses import photometric_loss, ssim, view_losses

SIZES = [(37, 52, 3), (64, 64, 3), (16, 16, 1), (5, 7, 4), (1, 1, 3), (130, 20, 2)]


def images(shape: tuple[int, ...], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth picture and a degraded copy, with flat parts as in volume renderings."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]] / 9.0
    picture = 0.5 + 0.4 * np.sin(x + np.arange(shape[2])[:, None, None]) * np.cos(1.3 * y)
    picture = np.moveaxis(picture, 0, -1)
    picture[: shape[0] // 4] = 1.0
    noisy = np.clip(picture + 0.1 * random.normal(size=shape), 0, 1)
    target, rendered = (torch.from_numpy(one.astype(np.float32)).double() for one in (picture, noisy))
    return rendered, target


def usual_ssim(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """SSIM of every pixel and channel by the 11×11 depthwise convolution of the lineage, zero-padded."""
    offset = torch.arange(11, dtype=x.dtype) - 5
    taps = torch.exp(-(offset**2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2
    window = window.expand(x.shape[2], 1, 11, 11)

    def blur(image: torch.Tensor) -> torch.Tensor:
        rows = functional.conv2d(image.permute(2, 0, 1)[None], window, padding=5, groups=image.shape[2])
        return rows[0].permute(1, 2, 0)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))


@pytest.mark.parametrize("shape", SIZES)
def test_ssim_is_the_usual_convolution(backend: Any, shape: tuple[int, ...]) -> None:
    rendered, target = images(shape)
    expected = usual_ssim(rendered, target).mean()
    assert ssim(rendered, target).item() == pytest.approx(expected.item(), abs=1e-12)
    single = rendered.float().to(backend.device), target.float().to(backend.device)
    assert ssim(*single, backend=backend.name).item() == pytest.approx(expected.item(), abs=2e-6)


def test_the_usual_convolution_is_scikit_images_inside_the_border() -> None:
    """Zero padding touches five pixels at the rim; scikit-image mirrors there."""
    rendered, target = images((60, 50, 3))
    _, full = structural_similarity(
        rendered.numpy(),
        target.numpy(),
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        truncate=3.5,
        use_sample_covariance=False,
        full=True,
    )
    padded = usual_ssim(rendered, target)
    np.testing.assert_allclose(padded[5:-5, 5:-5].numpy(), full[5:-5, 5:-5], atol=1e-7)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("shape", SIZES)
def test_loss_and_gradient_match_float64(
    splat: Any, backend: Any, shape: tuple[int, ...], weight: float
) -> None:
    rendered, target = images(shape, seed=2)
    exact = rendered.clone().requires_grad_(True)
    expected = photometric_loss(exact, target, weight)
    expected.backward()
    mine = rendered.float().to(backend.device).requires_grad_(True)
    actual = photometric_loss(mine, target.float().to(backend.device), weight, backend=backend.name)
    (3.0 * actual).backward()
    assert actual.item() == pytest.approx(expected.item(), rel=2e-5, abs=2e-6)
    assert splat.relative(mine.grad.double().cpu() / 3.0, exact.grad) < backend.tolerance


@pytest.mark.parametrize("part", ["dense", "faint", "colors alone"])
@pytest.mark.parametrize("size", [(37, 52), (5, 7), (1, 1), (130, 20)])
def test_losses_of_a_view_match_float64(splat: Any, backend: Any, size: tuple[int, int], part: str) -> None:
    """Colors over the background and alpha; where most alpha is missing, its error weighs more."""
    random = np.random.default_rng(3)
    strength, weight = {"dense": (0.9, 0.2), "faint": (0.1, 0.2), "colors alone": (0.9, 0.0)}[part]
    alpha = random.uniform(0.0, strength, size)
    alpha[size[0] // 2 + 1 :] = 0.0
    truth = random.uniform(size=(*size, 4))
    truth[..., :3] *= truth[..., 3:]
    truth[size[0] // 2 + 1 :] = 0.0
    exact = [torch.from_numpy(one.astype(np.float32)).double() for one in (alpha[..., None] * 0.7, alpha)]
    exact[0] = exact[0].expand(*size, 3).contiguous()
    target = torch.from_numpy(truth.astype(np.float32)).double()
    weights = {"ssim_weight": 0.2, "alpha_weight": weight}
    back = (1.0, 0.5, 0.25)
    results = []
    for given, view, name in (
        (exact, target, "torch"),
        ([one.float().to(backend.device) for one in exact], target.float().to(backend.device), backend.name),
    ):
        leaves = [one.clone().requires_grad_(True) for one in given]
        losses = view_losses(*leaves, view, back, backend=name, **weights)
        (2.0 * (losses[0] + losses[1]) if weight else 2.0 * losses[0]).backward()
        results.append((losses, [one.grad.double().cpu() for one in leaves]))
    (expected, gradients), (actual, mine) = results
    for one, other in zip(actual, expected, strict=True):
        assert one.item() == pytest.approx(other.item(), rel=2e-5, abs=2e-6)
    for one, other in zip(mine, gradients, strict=True):
        assert splat.relative(one, other) < backend.tolerance
    distance = float((exact[1] - target[..., 3]).abs().mean())
    assert float(expected[1]) == pytest.approx((1.0 if part == "faint" else weight) * distance)


def test_losses_of_a_view_have_the_gradient_of_their_sum() -> None:
    colors, alpha = torch.rand(4, 4, 3, requires_grad=True), torch.rand(4, 4, requires_grad=True)
    picture, _ = view_losses(colors, alpha, torch.rand(4, 4, 4), (1.0, 1.0, 1.0), alpha_weight=0.1)
    with pytest.raises(RuntimeError, match="gradient of their sum"):
        picture.backward()


def test_a_step_needs_nothing_from_the_host_but_its_picture() -> None:
    """The window, in float64, is computed once for a size of picture, not on the host at every step."""
    dtypes: set[torch.dtype] = set()

    class Work(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            made = func(*args, **(kwargs or {}))
            dtypes.update(one.dtype for one in tree_leaves(made) if isinstance(one, torch.Tensor))
            return made

    rendered, target = (one.float() for one in images((21, 33, 3)))
    photometric_loss(rendered, target, backend="torch")
    with Work():
        photometric_loss(rendered.requires_grad_(), target, backend="torch").backward()
    assert dtypes == {torch.float32}


def test_gradient_is_that_of_finite_differences() -> None:
    rendered, target = images((9, 8, 2))
    rendered = (rendered + 0.05).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda one: photometric_loss(one, target, 0.3), rendered, eps=1e-7)


def test_equal_images_have_no_loss(backend: Any) -> None:
    picture = images((30, 30, 3))[1].float().to(backend.device).requires_grad_(True)
    loss = photometric_loss(picture, picture.detach().clone(), backend=backend.name)
    loss.backward()
    assert abs(loss.item()) < 1e-6
    assert picture.grad.abs().max() < 1e-6


def test_images_of_another_memory_layout_are_the_same_images(backend: Any) -> None:
    rendered, target = (one.float().to(backend.device) for one in images((20, 33, 3)))
    strided = target.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided.is_contiguous()
    first = photometric_loss(rendered, target, backend=backend.name)
    assert photometric_loss(rendered, strided, backend=backend.name).item() == pytest.approx(first.item())


def test_shapes_must_agree() -> None:
    rendered, target = images((8, 8, 3))
    for wrong in (target[:4], target[..., 0], target[:0]):
        with pytest.raises(ValueError, match="image size"):
            photometric_loss(rendered, wrong)
    with pytest.raises(ValueError, match="view"):
        view_losses(rendered, target[..., 0], target, (1.0, 1.0, 1.0))
