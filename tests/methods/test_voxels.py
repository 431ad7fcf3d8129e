"""Voxel grids: a ray marcher of a few lines, both backends, finite differences, any number of threads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from econgs_bench.econgs.rays import Rays
from econgs_bench.econgs.splat import native
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.plenoxels.grid import SH, VoxelGrid, Voxels, bricks_of, lattice, links_of, occupied
from econgs_bench.methods.plenoxels.march import drawn, trace, voxel_weights
from econgs_bench.methods.plenoxels.optimise import rms_step, variation

SIZE = (21, 13, 17)


def grid_of(fill: float = 0.6, seed: int = 0, dtype: torch.dtype = torch.float32) -> VoxelGrid:
    """A lattice with voxels at random vertices, and none in one half of it; some densities are negative."""
    generator = torch.Generator().manual_seed(seed)
    inside = torch.rand(SIZE[::-1], generator=generator) < fill
    inside[:, :, 12:] = False
    links = links_of(inside)
    count = int(inside.sum())
    colors = torch.zeros(count, 32)
    colors[:, :SH] = 0.6 * torch.randn((count, SH), generator=generator)
    densities = 30.0 * torch.rand(count, generator=generator) - 8.0
    voxels = Voxels(densities.to(dtype), colors.to(dtype))
    return VoxelGrid(links, voxels, bricks_of(links), (-0.5, -0.3, -0.4), 0.05, 0.5)


def rays_through(count: int = 150, dtype: torch.dtype = torch.float32) -> Rays:
    generator = torch.Generator().manual_seed(3)
    origins = torch.nn.functional.normalize(torch.randn((count, 3), generator=generator)) * 1.4
    origins[: count // 10] *= 0.1  # from within
    aims = (torch.rand((count, 3), generator=generator) - 0.5) * 0.7
    directions = torch.nn.functional.normalize(aims - origins)
    directions[-1] = torch.tensor([0.0, 0.0, 1.0])  # along an axis
    near = 0.2 * torch.rand(count, generator=generator)
    return Rays(origins.to(dtype), directions.to(dtype), near.to(dtype))


def exact(grid: VoxelGrid) -> VoxelGrid:
    voxels = Voxels(grid.voxels.densities.double(), grid.voxels.colors.double())
    return replace(grid, voxels=voxels)


def slowly(grids: list[VoxelGrid], rays: Rays, factors: list[float]) -> np.ndarray:
    """(B, 4) colors and alpha: every sample of every ray, by SciPy's interpolation on dense arrays."""
    step = 0.5 * min(grid.spacing for grid in grids)
    dense = []
    for grid in grids:
        flat = np.zeros((grid.links.numel(), 1 + SH))
        place = occupied(grid.links).numpy()
        flat[place, 0] = grid.voxels.densities.numpy()
        flat[place, 1:] = grid.voxels.colors[:, :SH].numpy()
        dense.append(flat.reshape(*grid.links.shape, 1 + SH))
    result = []
    for origin, direction, near in zip(*(v.numpy() for v in vars(rays).values()), strict=True):
        sums, through = np.zeros(4), 1.0
        for k in range(math.ceil(max(near / step - 0.5, 0.0)), 200):
            place = origin + (k + 0.5) * step * direction
            total, mixed = 0.0, np.zeros(3)
            for grid, values, factor in zip(grids, dense, factors, strict=True):
                at = (place - np.array(grid.origin)) / grid.spacing
                if (at < 0).any() or (at >= np.array(grid.size) - 1).any():
                    continue
                numbers = [map_coordinates(values[..., c], at[::-1, None], order=1)[0] for c in range(1 + SH)]
                if numbers[0] <= 1e-8:
                    continue
                density = factor * numbers[0] / grid.unit
                coefficients = torch.tensor(np.reshape(numbers[1:], (3, 9)).T.copy())[None]
                color = spherical_harmonics(
                    2, torch.tensor(direction)[None].double(), torch.zeros(3), coefficients, backend="torch"
                )
                total += density
                mixed += density * color[0].numpy()
            if total > 0.0 and through >= 1e-7:
                after = through * math.exp(-total * step)
                sums[:3] += (through - after) * mixed / total
                through = after
        sums[3] = 1.0 - through
        result.append(sums)
    return np.stack(result)


@pytest.fixture(scope="module")
def pictures() -> list[tuple[list[VoxelGrid], list[float], Rays, np.ndarray]]:
    """One grid alone, and two that overlap: grids, factors, rays, what they see."""
    grids = [grid_of(), replace(grid_of(0.9, seed=1), origin=(-0.31, -0.27, -0.1), spacing=0.043, unit=0.7)]
    rays = rays_through(25)
    cases = (([grids[0]], [1.0]), (grids, [0.7, 1.3]))
    return [(some, factors, rays, slowly(some, rays, factors)) for some, factors in cases]


def test_both_backends_draw_what_every_sample_adds_up_to(isa: str, pictures: Any) -> None:
    for some, factors, rays, expected in pictures:
        precise = Rays(*(one.double() for one in vars(rays).values()))
        assert 0.2 < expected[:, 3].mean() < 0.95
        fast = torch.cat([one.reshape(len(rays), -1) for one in drawn(some, rays, factors)], dim=1)
        oracle = drawn([exact(one) for one in some], precise, factors)
        slow = torch.cat([one.reshape(len(rays), -1) for one in oracle], dim=1)
        np.testing.assert_allclose(slow.numpy(), expected, atol=2e-6)
        np.testing.assert_allclose(fast.numpy(), expected, atol=1e-5)


def gradients(grid: VoxelGrid, rays: Rays, outer: tuple[torch.Tensor, torch.Tensor]) -> list[torch.Tensor]:
    like = grid.voxels.densities
    to = Voxels.zeros(len(grid), like)
    trace(grid, rays).backward(outer[0].to(like), outer[1].to(like), to)
    return [to.densities, to.colors]


def test_gradients_of_both_backends_agree_and_repeat(isa: str) -> None:
    grid, rays = grid_of(), rays_through()
    generator = torch.Generator().manual_seed(1)
    outer = torch.randn((len(rays), 3), generator=generator), torch.randn(len(rays), generator=generator)
    precise = Rays(*(one.double() for one in vars(rays).values()))
    expected = gradients(exact(grid), precise, outer)
    results = []
    for threads in (1, 2, 3):
        native.set_threads(threads)
        results.append(gradients(grid, rays, outer))
        weights = torch.zeros(len(grid))
        voxel_weights(grid, rays, weights)
        results[-1].append(weights)
    most = torch.zeros(len(grid), dtype=torch.float64)
    voxel_weights(exact(grid), precise, most)
    for one, other in zip(results[0], [*expected, most], strict=True):
        assert float((one - other).norm() / other.norm()) < 2e-5
    for again in results[1:]:
        assert all(map(torch.equal, results[0], again))
    assert not results[0][1][:, SH:].any()


def test_gradients_are_those_of_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, rays = grid_of(), rays_through(30)
    outer = torch.rand(30, 3) + 0.5, torch.rand(30)
    slopes = gradients(grid, rays, outer)
    precise, exactly = Rays(*(one.double() for one in vars(rays).values())), exact(grid)

    def loss() -> float:
        colors, alpha = drawn([exactly], precise)
        return float((colors * outer[0]).sum() + (alpha * outer[1]).sum())

    strongest = slopes[0].abs().topk(12).indices.tolist()
    for row in strongest:
        for values, slope, column in (
            (exactly.voxels.densities, slopes[0][row], ...),
            (exactly.voxels.colors, slopes[1][row, 13], 13),
        ):
            target = values[row : row + 1] if column is ... else values[row, column : column + 1]
            before, step = target.clone(), 1e-4
            target += step
            above = loss()
            target -= 2 * step
            below = loss()
            target.copy_(before)
            assert (above - below) / (2 * step) == pytest.approx(float(slope), rel=2e-3, abs=2e-4)


def test_skipped_space_changes_nothing() -> None:
    grid, rays = grid_of(fill=0.02), rays_through()
    everywhere = replace(grid, bricks=torch.ones_like(grid.bricks))
    assert 0 < int(grid.bricks.sum()) < grid.bricks.numel()
    for one, other in zip(drawn([grid], rays), drawn([everywhere], rays), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-7)
    shown = grid.voxels.densities > 0
    bright = replace(grid, bricks=bricks_of(grid.links, shown))
    for one, other in zip(drawn([grid], rays), drawn([bright], rays), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-7)


def test_optical_depth_of_a_full_box_is_its_density_times_the_way() -> None:
    links = links_of(torch.ones(9, 9, 9, dtype=torch.bool))
    voxels = Voxels(torch.full((729,), 3.0), torch.zeros(729, 32))
    grid = VoxelGrid(links, voxels, bricks_of(links), (-0.5, -0.5, -0.5), 0.125, 0.5)
    way = torch.nn.functional.normalize(torch.tensor([[1.0, 0.3, -0.2]]))
    colors, alpha = drawn([grid], Rays(-2.0 * way, way, torch.zeros(1)))
    length = 1.0 / float(way[0, 0])
    assert float(alpha) == pytest.approx(1.0 - math.exp(-3.0 * length / 0.5), abs=1e-3)
    np.testing.assert_allclose(colors, 0.5 * alpha[:, None].expand(1, 3), rtol=1e-5)


def test_nothing_is_drawn_of_no_voxels() -> None:
    links = links_of(torch.zeros(4, 4, 4, dtype=torch.bool))
    empty = VoxelGrid(links, Voxels.zeros(0, torch.zeros(())), bricks_of(links), (-0.5, -0.5, -0.5), 0.3, 0.5)
    rays = rays_through()
    for grid in (empty, exact(empty)):
        colors, alpha = drawn([grid], rays)
        assert not colors.any()
        assert not alpha.any()
        seen = trace(grid, rays)
        seen.backward(seen.colors, seen.alpha, grid.voxels)
    alone, together = drawn([grid_of()], rays), drawn([grid_of(), replace(empty, spacing=0.05)], rays)
    assert torch.equal(alone[1], together[1])


def test_total_variation_of_both_backends(isa: str) -> None:
    grid = grid_of()
    total = grid.links.numel()
    begin, count = total - 500, 2000  # past the end
    results = []
    for one in (grid, exact(grid)):
        to = Voxels.zeros(len(one), one.voxels.densities)
        value = variation(one, begin, count, (0.3, 0.02), 0.8, to)
        results.append((torch.tensor(value, dtype=torch.float64), to.densities, to.colors))
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast.double(), slow.double(), rtol=2e-5, atol=2e-6)
    leaves = Voxels(*(one.clone().requires_grad_() for one in vars(exact(grid).voxels).values()))
    dense = torch.cat([leaves.densities[:, None], leaves.colors[:, :SH]], dim=1)
    flat = torch.full((total, 1 + SH), math.nan, dtype=torch.float64)
    flat[occupied(grid.links)] = dense
    cube = flat.reshape(*grid.links.shape, 1 + SH)
    squares = torch.zeros_like(cube)
    for axis in range(3):
        n = cube.shape[axis] - 1
        apart = cube.narrow(axis, 1, n) - cube.narrow(axis, 0, n)
        squares.narrow(axis, 0, n).add_(torch.where(apart.isnan(), 0.0, apart * 0.8).square())
    chosen = (begin + torch.arange(count)) % total
    chosen = chosen[grid.links.reshape(-1)[chosen] >= 0]
    sums = (1e-9 + squares.reshape(total, -1)[chosen]).sqrt().sum(0)
    assert float((0.3 * sums[0] + 0.02 * sums[1:].sum()).detach()) == pytest.approx(
        float(results[1][0]), rel=1e-9
    )


def test_rmsprop_moves_only_what_has_a_gradient(isa: str) -> None:
    generator = torch.Generator().manual_seed(0)

    def three(dtype: torch.dtype) -> list[Voxels]:
        generator.manual_seed(0)
        draws = [
            [torch.randn(40, generator=generator), torch.randn((40, 32), generator=generator)]
            for _ in range(3)
        ]
        draws[1][0][::3], draws[1][1][::2] = 0.0, 0.0
        draws[2][0].square_()
        draws[2][1].square_()
        draws[2][0][:20], draws[2][1][:20] = 0.0, 0.0
        return [Voxels(*(one.to(dtype) for one in pair)) for pair in draws]

    fast, slow = three(torch.float32), three(torch.float64)
    before = [one.clone() for one in vars(fast[0]).values()]
    gradient = [one.clone() for one in vars(fast[1]).values()]
    for voxels in (fast, slow):
        rms_step(*voxels, (0.3, 0.01), 0.95)
    for one, other in zip(fast, slow, strict=True):
        for name in ("densities", "colors"):
            torch.testing.assert_close(
                getattr(one, name).double(), getattr(other, name), rtol=1e-5, atol=1e-6
            )
    assert not fast[1].densities.any()
    assert not fast[1].colors.any()
    assert torch.equal(fast[0].colors[::2], before[1][::2])
    # The first step of RMSProp here is the rate itself, against the sign.
    expected = before[0][:20] - 0.3 * gradient[0][:20].sign()
    torch.testing.assert_close(fast[0].densities[:20], expected, rtol=0, atol=1e-6)


def test_links_number_every_voxel_once() -> None:
    inside = torch.rand(7, 9, 5, generator=torch.Generator().manual_seed(0)) < 0.4
    links = links_of(inside)
    assert torch.equal(links >= 0, inside)
    assert links[inside].sort().values.tolist() == list(range(int(inside.sum())))
    place = occupied(links)
    assert links.reshape(-1)[place].tolist() == list(range(len(place)))
    assert lattice((1.0, 0.5, 0.26), 0.25) == (5, 3, 3)


def test_a_finer_grid_shows_the_same() -> None:
    links = links_of(torch.ones(9, 9, 9, dtype=torch.bool))
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, 9)] * 3, indexing="ij")
    place = occupied(links)
    colors = torch.zeros(729, 32)
    colors[:, :SH] = torch.stack([x, y, z] * 9, dim=-1).reshape(-1, SH)[place]  # linear: interpolated exactly
    voxels = Voxels((3.0 + 2.0 * x + y).reshape(-1)[place], colors)
    grid = VoxelGrid(links, voxels, bricks_of(links), (-0.5, -0.5, -0.5), 0.125, 0.5)
    fine = grid.finer(17, torch.ones(729, dtype=torch.bool))
    assert fine.size == (17, 17, 17)
    assert len(fine) == 17**3
    assert fine.spacing == 0.0625
    rays = rays_through()
    both = drawn([grid, replace(fine, voxels=Voxels.zeros(len(fine), torch.zeros(())))], rays)
    for one, other in zip(both, drawn([fine], rays), strict=True):  # at the finer of the two steps
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)
    corner = torch.zeros(729, dtype=torch.bool)
    corner[links[0, 0, 0]] = True
    assert len(grid.finer(17, corner)) == 8  # the vertices nearer than one old spacing
    partial = replace(grid, links=torch.where(torch.arange(729).reshape(9, 9, 9) == 0, links, -1))
    alone = replace(partial, voxels=Voxels(voxels.densities[:1], colors[:1]))
    finer = alone.finer(17, torch.ones(1, dtype=torch.bool))
    torch.testing.assert_close(finer.voxels.colors, colors[:1].expand(8, 32))  # absent colors are not gray
    assert float(finer.voxels.densities.min()) == pytest.approx(float(voxels.densities[0]) / 8)


def test_sizes_that_do_not_fit_are_refused() -> None:
    grid: Any = grid_of()
    module: Any = __import__("econgs_bench.econgs._native", fromlist=["march"])
    rays = rays_through(4)
    arrays = [[one.numpy()] for one in (grid.links, grid.voxels.densities, grid.voxels.colors, grid.bricks)]
    placement = np.array([grid.placement(0.02)])
    rest = [one.numpy() for one in vars(rays).values()]
    out = np.empty((4, 3), np.float32), np.empty(4, np.float32)
    module.march(*arrays, placement, 0.02, *rest, *out, False)
    with pytest.raises(ValueError, match="step"):
        module.march(*arrays, placement, 0.0, *rest, *out, False)
    with pytest.raises(ValueError, match="placements"):
        module.march(*arrays, placement[:, :4].copy(), 0.02, *rest, *out, False)
    with pytest.raises(ValueError, match="another size"):
        module.march(*arrays, placement, 0.02, *rest, out[0][:3], out[1], False)
    with pytest.raises(ValueError, match="bricks"):
        module.march(*arrays[:3], [grid.bricks[1:].contiguous().numpy()], placement, 0.02, *rest, *out, False)
