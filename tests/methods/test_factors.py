"""Fields of factors and rays through them, against dense evaluations in float64 and finite differences."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from econgs_bench.econgs.rays import Rays
from econgs_bench.econgs.splat import native
from econgs_bench.methods.ccnerf.lines import dense, line_products, resampled
from econgs_bench.methods.ccnerf.rays import Region, Samples, hits, march, ray_sums, ray_weights

SIZES, GROUPS, RANKS, RAYS, COUNT = (5, 7, 4), 3, 16, 6, 40


@pytest.fixture(params=["native", "torch"])
def backend(request, monkeypatch):
    if request.param == "torch":
        monkeypatch.setenv("ECONGS_BACKEND", "torch")
    return request.param


def problem(ranks=RANKS, seed=0):
    generator = torch.Generator().manual_seed(seed)
    total = GROUPS * ranks
    lines = tuple(torch.randn((size, total), generator=generator) for size in SIZES)
    places = torch.rand((COUNT, 3), generator=generator)
    places[0], places[1] = 0.0, 1.0
    mixing = torch.randn((RAYS, 3, total), generator=generator)
    rays = torch.randint(RAYS, (COUNT,), generator=generator).sort().values.int()
    return lines, places, mixing, rays


def by_dense_grids(lines, places, mixing, rays):
    """(N, groups, 3) from the dense grid of every rank, interpolated by SciPy in float64."""
    x, y, z = (line.detach().double().numpy() for line in lines)
    axes = [np.linspace(0.0, 1.0, size) for size in SIZES]
    at = places.double().numpy()
    values = np.stack(
        [
            RegularGridInterpolator(axes, np.einsum("i,j,k->ijk", x[:, r], y[:, r], z[:, r]))(at)
            for r in range(x.shape[1])
        ],
        axis=1,
    )
    mixed = values[:, None] * mixing.detach().double().numpy()[rays.numpy()]
    return mixed.reshape(COUNT, 3, GROUPS, -1).sum(-1).transpose(0, 2, 1)


@pytest.mark.parametrize("ranks", [16, 5, 48])
def test_products_are_those_of_the_dense_grids(backend, ranks):
    lines, places, mixing, rays = problem(ranks)
    expected = by_dense_grids(lines, places, mixing, rays)
    found = line_products(lines, places, GROUPS, mixing, rays)
    np.testing.assert_allclose(found.numpy(), expected, atol=3e-4)
    plain = line_products(lines, places, GROUPS)
    ones = by_dense_grids(lines, places, torch.ones_like(mixing), rays)
    np.testing.assert_allclose(plain[..., 0].numpy(), ones[..., 0], atol=3e-4)


@pytest.mark.parametrize("mixed", [True, False])
@pytest.mark.parametrize("ranks", [16, 5])
def test_gradients_are_those_of_the_dense_sum_in_float64(backend, mixed, ranks):
    lines, places, mixing, rays = problem(ranks, seed=1)
    outer = torch.randn((COUNT, GROUPS, 3 if mixed else 1), generator=torch.Generator().manual_seed(2))

    def gradients(dtype, explicit):
        leaves = [one.detach().to(dtype).requires_grad_(True) for one in (*lines, mixing)]
        own, weights = tuple(leaves[:3]), leaves[3] if mixed else None
        if explicit:  # all hat functions of all rows, no gather
            values = 1.0
            for axis, line in enumerate(own):
                apart = places[:, axis : axis + 1].to(dtype) * (len(line) - 1) - torch.arange(len(line))
                values = values * ((1.0 - apart.abs()).clamp(min=0.0) @ line)
            values = values[:, None] * (weights[rays.long()] if mixed else 1.0)
            out = values.reshape(COUNT, -1, GROUPS, ranks).sum(-1).transpose(1, 2)
        else:
            out = line_products(own, places, GROUPS, weights, rays)
        (out * outer.to(dtype)).sum().backward()
        return [leaf.grad for leaf in leaves[: 3 + mixed]]

    for found, expected in zip(gradients(torch.float32, False), gradients(torch.float64, True), strict=True):
        torch.testing.assert_close(found.double(), expected, atol=2e-4, rtol=1e-4)


def test_instruction_sets_and_threads_agree():
    lines, places, mixing, rays = problem(48)
    before, found = (native.isa(), native.threads()), {}
    try:
        for isa in native.available_isas(testing=True):
            native.set_isa(isa)
            for threads in (1, 3):
                native.set_threads(threads)
                leaves = [one.clone().requires_grad_(True) for one in (*lines, mixing)]
                out = line_products(tuple(leaves[:3]), places, GROUPS, leaves[3], rays)
                out.square().sum().backward()
                found[isa, threads] = [out.detach(), *(leaf.grad for leaf in leaves)]
    finally:
        native.set_isa(before[0])
        native.set_threads(before[1])
    first = next(iter(found.values()))
    for (isa, threads), tensors in found.items():
        for one, other in zip(tensors, first, strict=True):
            torch.testing.assert_close(one, other, atol=1e-3, rtol=1e-4)
        for one, other in zip(tensors, found[isa, 1], strict=True):
            assert torch.equal(one, other), threads


def test_a_group_does_not_depend_on_those_behind_it():
    lines, places, mixing, rays = problem()
    whole = line_products(lines, places, GROUPS, mixing, rays)
    x, y, z = (line[:, : 2 * RANKS].contiguous() for line in lines)
    part = line_products((x, y, z), places, 2, mixing[..., : 2 * RANKS].contiguous(), rays)
    assert torch.equal(whole[:, :2], part)


def test_dense_values_and_other_sizes_of_lines():
    lines, *_ = problem()
    x, y, z = (line.double().numpy() for line in lines)
    np.testing.assert_allclose(dense(lines).numpy(), np.einsum("ir,jr,kr->kji", x, y, z), atol=1e-4)
    fine = resampled(lines[0], 11)
    places = np.linspace(0.0, 1.0, 11)
    expected = [np.interp(places, np.linspace(0.0, 1.0, SIZES[0]), column) for column in x.T]
    np.testing.assert_allclose(fine.numpy(), np.stack(expected, axis=1), atol=1e-5)


# --------------------------------------------------------------------------- rays


def bundle(count=50, seed=3):
    generator = torch.Generator().manual_seed(seed)
    origins = 3.0 * torch.nn.functional.normalize(
        torch.randn((count, 3), generator=generator, dtype=torch.float64), dim=1
    )
    aims = torch.rand((count, 3), generator=generator, dtype=torch.float64) - 0.5
    directions = torch.nn.functional.normalize(aims - origins, dim=1)
    return Rays(origins, directions, torch.zeros(count)), torch.rand(
        count, generator=generator, dtype=torch.float64
    )


def region(seed=4):
    generator = torch.Generator().manual_seed(seed)
    cells = (torch.rand((5, 3, 4), generator=generator) < 0.4).to(torch.uint8)
    return Region((-0.6, -0.4, -0.5), (0.5, 0.7, 0.4), cells)


def test_samples_are_all_those_in_occupied_cells(backend):
    rays, shift = bundle()
    box, step = region(), 0.013
    low, high = (torch.tensor(one, dtype=torch.float64) for one in (box.low, box.high))
    expected = []
    for ray in range(len(shift)):
        for k in range(600):
            point = rays.origins[ray] + (k + shift[ray]) * step * rays.directions[ray]
            place = (point - low) / (high - low)
            if bool(((place >= 0) & (place <= 1)).all()):
                x, y, z = (int(p * n) for p, n in zip(place, (4, 3, 5), strict=True))
                if box.cells[z, y, x]:
                    expected.append((ray, k, *place.tolist()))
    samples = march(box, step, rays, shift)
    found = torch.stack([samples.rays.double(), samples.numbers.double(), *samples.places.double().T], dim=1)
    np.testing.assert_allclose(found.numpy(), np.array(expected), atol=1e-6)
    assert samples.first.tolist() == [int((samples.rays < ray).sum()) for ray in range(len(shift) + 1)]


def test_rays_that_miss_have_no_samples(backend):
    rays, _ = bundle(8)
    away = Rays(rays.origins, -rays.directions, rays.near)
    full = Region((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), torch.ones((1, 1, 1), dtype=torch.uint8))
    assert hits(full, 0.05, rays).all()
    assert not hits(full, 0.05, away).any()
    assert not hits(Region(full.low, full.high, torch.zeros((2, 2, 2), dtype=torch.uint8)), 0.05, rays).any()
    outwards = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    inside = Rays(torch.zeros_like(outwards), outwards, torch.zeros(1))
    samples = march(full, 0.125, inside, torch.full((1,), 0.5, dtype=torch.float64))
    assert samples.numbers.tolist() == list(range(8))


def chain(depths):
    """Weights of one ray, term by term in float64."""
    through, weights = 1.0, []
    for depth in depths:
        weights.append(through * (1.0 - math.exp(-depth)))
        through *= math.exp(-depth)
    return weights


def test_weights_and_sums_along_rays(backend):
    rows = [[0.3, 0.0, 2.0], [], [1e-6, 30.0], [0.7]]
    first = torch.tensor([0, 3, 3, 5, 6])
    owners = torch.tensor([0, 0, 0, 2, 2, 3], dtype=torch.int32)
    samples = Samples(torch.empty(6, 3), owners, owners, first)
    depths = torch.tensor([depth for row in rows for depth in row], requires_grad=True)
    weights = ray_weights(depths, samples)
    expected = [weight for row in rows for weight in chain(row)]
    np.testing.assert_allclose(weights.detach().numpy(), expected, rtol=1e-5, atol=1e-9)
    values = torch.arange(12.0).reshape(6, 2)
    sums = ray_sums(weights[:, None] * values, owners, 4)
    by_hand = np.zeros((4, 2))
    for weight, value, owner in zip(expected, values.numpy(), owners, strict=True):
        by_hand[owner] += weight * value
    np.testing.assert_allclose(sums.detach().numpy(), by_hand, rtol=1e-5)

    factors = torch.tensor([[1.0, -2.0], [3.0, 1.0], [0.5, 2.0], [-1.0, 4.0]])
    (sums * factors).sum().backward()

    def loss(row, change):
        moved = [[one + (change if at == row else 0.0) for at, one in places] for places in numbered]
        return sum(
            weight * float((values[at].double() * factors[owners[at]].double()).sum())
            for line, places in zip(moved, numbered, strict=True)
            for weight, (at, _) in zip(chain(line), places, strict=True)
        )

    numbers = iter(range(6))
    numbered = [[(next(numbers), depth) for depth in row] for row in rows]
    slopes = [(loss(row, 1e-6) - loss(row, -1e-6)) / 2e-6 for row in range(6)]
    np.testing.assert_allclose(depths.grad.numpy(), slopes, rtol=1e-4, atol=1e-5)


def test_arrays_that_do_not_fit_are_refused():
    lines, places, mixing, rays = problem()
    with pytest.raises(ValueError, match="at least 2 rows"):
        line_products((lines[0][:1], *lines[1:]), places)
    with pytest.raises(ValueError, match="ray that is not there"):
        line_products(lines, places, GROUPS, mixing[:1].contiguous(), rays)
