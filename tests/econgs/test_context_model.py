"""The context model: probabilities, noise, gradients, agreement with the integers, what context is worth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import norm

from econgs_bench.econgs.codec.hash_grid import GridConfig
from econgs_bench.econgs.codec.integer import whole_values
from econgs_bench.econgs.codec.model import (
    Attributes,
    ContextConfig,
    ContextModel,
    Noise,
    _AddNoise,
    _Head,
    draw_sample,
    normal_bits,
)
from econgs_bench.econgs.codec.tables import coding_table, low_bits, spread_table
from econgs_bench.econgs.optim import Adam

GRID = GridConfig(volume=(4, 8, 16), planes=(32,), volume_log2=10, planes_log2=10)
CONFIG = ContextConfig(features=6, offsets=2, grid=GRID, hidden=24)
EXTENT = (1000, 1000, 1000)


def scene(count: int, seed: int = 0, noise: float = 1.0) -> tuple[torch.Tensor, Attributes]:
    """Position codes, and attributes that follow the position up to noise."""
    random = np.random.default_rng(seed)
    codes = random.integers(0, 1001, (count, 3))
    x = codes / 1000.0
    wave = np.stack([np.sin(4 * x[:, i % 3] + i) * np.cos(3 * x[:, (i + 1) % 3]) for i in range(18)], 1)
    flat = wave + noise * 0.1 * random.normal(size=wave.shape)
    scalings = 0.01 * np.exp(0.5 * flat[:, 6:12])
    parts = (0.4 * flat[:, :6], scalings, flat[:, 12:].reshape(count, 2, 3))
    return torch.from_numpy(codes), Attributes(*(torch.from_numpy(one.astype(np.float32)) for one in parts))


def model_for(values: Attributes, seed: int = 0) -> ContextModel:
    model = ContextModel(CONFIG, torch.Generator().manual_seed(seed))
    model.calibrate(values)
    return model


def test_bits_are_those_of_the_normal_distribution() -> None:
    random = np.random.default_rng(0)
    values, mean, sigma = random.normal(size=(3, 400)) * [[2.0], [1.0], [0.0]] + [[0], [0], [1.5]]
    sigma *= np.exp(random.normal(size=400))
    step = np.exp(random.normal(size=400))
    low, high = (values - mean - step / 2) / sigma, (values - mean + step / 2) / sigma
    exact = -np.log2(np.maximum(norm.cdf(-np.abs(low + high) / 2 + (high - low) / 2)
                                - norm.cdf(-np.abs(low + high) / 2 - (high - low) / 2), 1e-6))  # fmt: skip
    tensors = [torch.from_numpy(one) for one in (values, mean, sigma, step)]
    np.testing.assert_allclose(normal_bits(*tensors).numpy(), exact, rtol=1e-9, atol=1e-9)
    single = normal_bits(*(one.float() for one in tensors)).numpy()
    np.testing.assert_allclose(single, exact, rtol=2e-3, atol=1e-5)
    far = normal_bits(*(torch.tensor([one], requires_grad=True) for one in (50.0, 0.0, 1.0, 1.0)))
    assert far.item() == pytest.approx(-np.log2(1e-6), rel=1e-6)


def test_gradients_of_bits() -> None:
    """By finite differences where the probability is above its least; below it, the mean is still pulled."""
    random = torch.Generator().manual_seed(0)
    values, mean = (torch.randn(30, generator=random, dtype=torch.float64) for _ in range(2))
    sigma, step = (torch.rand(30, generator=random, dtype=torch.float64) + 0.4 for _ in range(2))
    leaves = [one.requires_grad_(True) for one in (values, mean, sigma, step)]
    assert torch.autograd.gradcheck(normal_bits, leaves)
    far = [torch.tensor([one], dtype=torch.float64, requires_grad=True) for one in (6.0, 0.0, 1.0, 0.5)]
    normal_bits(*far).sum().backward()
    assert far[1].grad < 0 < far[0].grad
    assert far[2].grad < 0


def test_noise_stands_for_rounding(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", "torch" if backend.name == "gsplat" else backend.name)
    codes, values = scene(300)
    model = model_for(values).to(backend.device)
    values = Attributes(*(one.to(backend.device) for one in values))
    with torch.no_grad():
        model.refinements.weight.normal_(std=0.3)
    lookup = model.lookup(codes, EXTENT)
    rows = torch.arange(0, 300, 2, device=backend.device)
    context = model(lookup, rows, draw_sample(150, torch.Generator().manual_seed(0), 0.2))
    noise = Noise(1 << 12, generator=torch.Generator().manual_seed(1), device=backend.device)
    noisy = model.perturb(values.of(rows), context, noise)
    away = (noisy.values.flat - values.of(rows).flat) / model.element_steps(context.steps)
    assert away.abs().max() <= 0.5 + 1e-4
    assert away.abs().max() > 0.49
    assert abs(away.mean()) < 0.02
    assert torch.equal(noisy.sample, noisy.values.flat[context.sample])
    assert torch.equal(context.sample_steps, context.steps[context.sample])
    rounded = model.round(values.of(rows), context.steps)
    whole = rounded.flat / model.element_steps(context.steps)
    assert (whole - whole.round()).abs().max() < 1e-3
    assert (
        (rounded.flat - values.of(rows).flat).abs() <= 0.5001 * model.element_steps(context.steps) + 1e-7
    ).all()


def test_rounding_pulls_at_steps_as_noise_of_its_size_would() -> None:
    """Without a gradient of the distortion only the rate would move steps, and only upwards."""
    _, values = scene(40)
    steps = torch.rand(40, 4, generator=torch.Generator().manual_seed(3)) * 0.1 + 0.05
    steps.requires_grad_(True)
    model = model_for(values)
    rounded = model.round(values, steps)
    outer = Attributes(*(torch.randn(one.shape) for one in values))
    sum((a * b).sum() for a, b in zip(rounded, outer, strict=True)).backward()  # type: ignore[union-attr]
    each = model.element_steps(steps.detach())
    noise = torch.round(values.flat / each) - values.flat / each
    parts = (noise * outer.flat).split(CONFIG.widths, 1)
    torch.testing.assert_close(
        steps.grad, torch.stack([one.sum(1) for one in parts], 1), atol=1e-3, rtol=1e-3
    )


def test_gradients_of_noise_and_head() -> None:
    """Of the fused functions, in float64 by finite differences."""
    random = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=random, dtype=torch.float64).requires_grad_(True)

    sample, noise = torch.tensor([3, 0, 3]), draw(5, 2, 3).detach()
    for first, groups in ((0, 1), (1, 2)):
        assert torch.autograd.gradcheck(
            lambda v, s, f=first, g=groups: _AddNoise.apply(v, s, noise, sample, f, g),
            (draw(5, 2, 3), draw(5, 4)),
        )
    inputs = (draw(7, 5), draw(6, 5), draw(6), draw(4, 6), draw(4))
    assert torch.autograd.gradcheck(lambda *a: _Head.apply(*a, 3), inputs)


def test_native_noise_has_the_gradients_of_the_torch_one(splat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if splat.native is None:
        pytest.skip("econgs_bench.econgs._native is not compiled here")
    random = np.random.default_rng(0)
    values, noise, outer = (
        torch.from_numpy(random.normal(size=(2000, 54)).astype(np.float32)) for _ in range(3)
    )
    steps = torch.from_numpy(random.uniform(0.5, 1, (2000, 4)).astype(np.float32))
    sample = torch.from_numpy(random.integers(0, 2000, 99))
    results = {}
    for name in ("native", "torch"):
        monkeypatch.setenv("ECONGS_BACKEND", name)
        leaves = values.clone().requires_grad_(True), steps.clone().requires_grad_(True)
        out, sampled = _AddNoise.apply(*leaves, noise, sample, 1, 2)
        ((out * outer).sum() + (sampled * outer[:99]).sum()).backward()
        results[name] = (out.detach(), sampled.detach(), *(one.grad for one in leaves))
    for ours, theirs in zip(*results.values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def trained() -> tuple[ContextModel, torch.Tensor, Attributes]:
    """A context model fitted to attributes that follow the position."""
    codes, values = scene(3000)
    model = model_for(values)
    lookup = model.lookup(codes, EXTENT)
    noise = Noise(1 << 18, generator=torch.Generator().manual_seed(2))
    random = torch.Generator().manual_seed(3)
    optimiser = Adam({"grid": model.grid.table, "head": model.head}, {"grid": 5e-3, "head": 5e-3})
    for step in range(400):
        model.coder_exact = step >= 300
        optimiser.learning_rates = dict.fromkeys(optimiser.learning_rates, 5e-3 * 0.01 ** (step / 400))
        rows = torch.randint(3000, (1000,), generator=random)
        context = model(lookup, rows, draw_sample(1000, random, 0.3))
        rate = model.mean_bits(model.perturb(values.of(rows), context, noise), context, anchors=3000)
        # The steps have no distortion to answer for here: they stay.
        model.refinements.requires_grad_(False)
        optimiser.zero_grad()
        (rate.attributes + rate.grid).backward()
        optimiser.step()
    return model, codes, values


def test_context_is_worth_its_bits(trained: tuple[ContextModel, torch.Tensor, Attributes]) -> None:
    """Against the best normal distribution per element that does not know the position."""
    model, codes, values = trained
    rounded, bits = model.rounded(values, model.lookup(codes, EXTENT))
    flat = rounded.flat.double()
    steps = model.element_steps(torch.tensor([model.config.steps])).double()
    sigma = (flat.var(0, correction=0) + steps**2 / 12).sqrt()
    plain = normal_bits(flat, flat.mean(0), sigma, steps).sum().item()
    assert bits.sum().item() < 0.75 * plain
    # On other anchors of the same field, too.
    other_codes, other = scene(1500, seed=9)
    _, other_bits = model.rounded(other, model.lookup(other_codes, EXTENT))
    assert other_bits.sum().item() / 1500 < 0.85 * plain / 3000


def test_twin_agrees_with_the_integer_model(trained: tuple[ContextModel, torch.Tensor, Attributes]) -> None:
    """With the coder's rounding switched on, the float model says what the integers say."""
    model, codes, _ = trained
    with torch.no_grad():
        model.refinements.weight.normal_(std=0.5, generator=torch.Generator().manual_seed(0))
    model.coder_exact = True
    lookup = model.lookup(codes, EXTENT)
    with torch.no_grad():
        every = model(lookup, None, torch.arange(3000))
        mean, sigma = model.distribution(every.sample_hidden)
        coding = model.integer_head()(whole_values(model.grid(lookup)[0]))
    model.refinements.weight.data.zero_()
    steps = torch.from_numpy(coding.steps).float() / 65536 * torch.tensor(model.config.steps)
    same = (steps == every.steps).double().mean()
    assert same > 0.999  # a refinement may lie within float32's rounding of a boundary
    assert len(torch.unique(steps)) > 50
    rows = (steps == every.steps).all(1)
    q = model.element_steps(every.steps)[rows].numpy()
    table = coding.table[rows.numpy()].astype(int)
    fine = table < 56 * 16
    parts = np.where(fine, table % 16 - 8, 0) / 16.0
    predicted = coding.center[rows.numpy()] + parts
    assert np.abs(predicted - mean[rows].numpy() / q)[fine].max() < 1 / 32 + 2e-3
    spread = spread_table()[np.where(fine, table // 16, table - 56 * 15)] / 65536
    ratio = np.log2(spread / np.clip(sigma[rows].numpy() / q, spread_table()[0] / 65536, None))
    assert np.abs(ratio).max() < 1 / 16 + 2e-3
    assert coding_table(0)[0] < 0
    assert low_bits(56 * 16 - 1) == 0


def test_each_attribute_is_rounded_to_multiples_of_its_own_step() -> None:
    _, values = scene(200)
    model = model_for(values)
    random = torch.Generator().manual_seed(4)
    steps = (0.1 + torch.rand((200, 4), generator=random)) * torch.tensor(CONFIG.steps)
    rounded, each = model.round(values, steps).flat, model.element_steps(steps)
    whole = rounded / each
    torch.testing.assert_close(whole, whole.round(), rtol=0, atol=1e-3)
    assert ((rounded - values.flat).abs() <= 0.501 * each).all()
    assert (rounded != values.flat).any(0).all()


def test_a_second_stage_begins_with_the_statistics_of_the_attributes() -> None:
    """What the head learns is the difference that the position makes."""
    _, values = scene(3000)
    model = ContextModel(model_for(values).config, torch.Generator().manual_seed(1))
    before = model.distribution(torch.zeros(1, model.config.hidden))
    model.calibrate(values)
    mean, sigma = (one[0] for one in model.distribution(torch.zeros(1, model.config.hidden)))
    flat = values.flat
    torch.testing.assert_close(mean, flat.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(sigma, flat.std(0, correction=0), rtol=1e-3, atol=0)
    assert not torch.allclose(before[1][0], sigma, rtol=0.1)


def test_refinement_reaches_small_steps() -> None:
    """The literal Q = 1 of features must be able to become 0.001 of it."""
    model = ContextModel(CONFIG)
    with torch.no_grad():
        model.refinements.bias.fill_(-9.0)
    model.coder_exact = True
    context = model(model.lookup(torch.zeros((1, 3), dtype=torch.int64), EXTENT))
    assert (context.steps / torch.tensor(CONFIG.steps)).max() < 1e-3
    assert context.steps.min() > 0


def test_no_anchors_in_view() -> None:
    codes, values = scene(20)
    model = model_for(values)
    none = torch.empty(0, dtype=torch.int64)
    context = model(model.lookup(codes, EXTENT), none, draw_sample(0, torch.Generator()))
    noisy = model.perturb(values.of(none), context, Noise(100, generator=torch.Generator()))
    rate = model.mean_bits(noisy, context, anchors=20)
    (rate.attributes + rate.grid).backward()
    assert rate.attributes.item() == 0
    assert rate.grid.item() > 0
    assert torch.isfinite(model.grid.table.grad).all()


def test_one_seed_one_model() -> None:
    first, second = (ContextModel(CONFIG, torch.Generator().manual_seed(7)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
