"""A scene of factors: densities and colors along rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.rays import Rays
from econgs_bench.econgs.splat.sh import harmonics
from econgs_bench.methods.ccnerf.lines import Lines, line_products
from econgs_bench.methods.ccnerf.rays import Region, Samples, march, ray_sums, ray_weights

DEGREE = 3
BANDS = (DEGREE + 1) ** 2
SHIFT = -10.0
"""Added to the sum of products before the softplus: first densities are close to 0."""
SCALE = 25.0
"""Optical depth of density 1 over a unit of length."""
_AT_ONCE = 8192  # rays of a picture


@dataclass(frozen=True, eq=False)
class Factors:
    """One scene of factors as it is optimised and stored.

    Density is softplus(Σ products − 10). Color is the sigmoid of Σ products · SH coefficients · SH of the
    direction of view.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        region: box and occupied cells.
        density: lines of the density, (size, ranks) each.
        color: lines of the color, (size, ranks) each.
        harmonics: (16, 3, color ranks) SH coefficients.
        group: color ranks of a group.
        spacing: distance of samples, in cells.
        threshold: weight in a pixel up to which a sample has no color.
    """

    name: str
    background: RGB
    region: Region
    density: Lines
    color: Lines
    harmonics: Tensor
    group: int
    spacing: float
    threshold: float

    def __len__(self) -> int:
        """Number of ranks, of density and color together."""
        return self.density[0].shape[1] + self.color[0].shape[1]

    @property
    def step(self) -> float:
        """Distance of samples along a ray: a share of the mean side of a cell."""
        sides = zip(self.region.low, self.region.high, self.density, strict=True)
        cells = [(high - low) / (len(line) - 1) for low, high, line in sides]
        return self.spacing * math.fsum(cells) / 3.0

    def truncated(self, ranks: int) -> Factors:
        """The scene with its first color ranks alone."""
        x, y, z = (one[:, :ranks].contiguous() for one in self.color)
        return replace(self, color=(x, y, z), harmonics=self.harmonics[..., :ranks].contiguous())

    def densities(self, places: Tensor) -> Tensor:
        """(N,) densities at places (N, 3) of the box."""
        return functional.softplus(line_products(self.density, places)[:, 0, 0] + SHIFT)

    def features(self, places: Tensor, rays: Tensor, basis: Tensor, groups: int = 1) -> Tensor:
        """(N, groups, 3) color before the sigmoid, each group alone.

        Args:
            places: (N, 3) in the box.
            rays: (N,) int32, the ray of each.
            basis: (B, 16) spherical harmonics of the rays' directions.
            groups: number of groups.
        """
        mixing = (basis @ self.harmonics.flatten(1)).reshape(len(basis), 3, -1)
        return line_products(self.color, places, groups, mixing, rays)


def harmonics_of(rays: Rays, like: Tensor) -> Tensor:
    """(B, 16) spherical harmonics of directions, of the type and on the device of a tensor."""
    return harmonics(DEGREE, rays.directions).to(like)


class Traced(NamedTuple):
    """What a batch of rays sees with each number of groups.

    Attributes:
        colors: (B, groups, 3) premultiplied; the last with all groups.
        alpha: (B,).
    """

    colors: Tensor
    alpha: Tensor


def trace(scene: Factors, rays: Rays, shift: Tensor, groups: int) -> Traced:
    """Rays through one scene, differentiable with respect to its factors.

    Args:
        scene: the scene.
        rays: B rays on the CPU.
        shift: (B,) in [0, 1], of the samples of each ray, in steps.
        groups: groups of color ranks; there are pictures of the first, the first two, and so on.
    """
    like = scene.harmonics
    samples = march(scene.region, scene.step, rays, shift).to(str(like.device))
    depths = scene.densities(samples.places) * (SCALE * scene.step)
    weights = ray_weights(depths, samples)
    seen = (weights.detach() > scene.threshold).nonzero()[:, 0]
    owners = samples.rays[seen]
    features = scene.features(samples.places[seen], owners, harmonics_of(rays, like), groups)
    colors = features.cumsum(1).sigmoid() * weights[seen][:, None, None]
    count = len(rays)
    picture = ray_sums(colors.flatten(1), owners, count).reshape(count, groups, 3)
    return Traced(picture, ray_sums(weights[:, None], samples.rays, count)[:, 0])


@torch.no_grad()
def drawn(
    scenes: Sequence[Factors], factors: Sequence[float], rays: Rays, clock: Callable[[str], None]
) -> tuple[Tensor, Tensor]:
    """Premultiplied colors (B, 3) and alpha (B,) of rays through scenes that share their space.

    Samples of all scenes lie at the same places. Densities add up. Features of a sample are blended by the
    softmax of the densities of those scenes that have something there.

    Args:
        scenes: at least one.
        factors: on the density of each.
        rays: on the CPU.
        clock: is told "decode" and "shade" when densities and colors are done, of each part of the rays.
    """
    parts = []
    for begin in range(0, len(rays), _AT_ONCE):
        part = rays[begin : begin + _AT_ONCE]
        parts.append(_drawn(scenes, factors, part, clock))
    colors, alphas = zip(*parts, strict=True)
    return torch.cat(colors), torch.cat(alphas)


def _drawn(
    scenes: Sequence[Factors], factors: Sequence[float], rays: Rays, clock: Callable[[str], None]
) -> tuple[Tensor, Tensor]:
    count, like = len(rays), scenes[0].harmonics
    shift = torch.full((count,), 0.5, dtype=torch.float64)
    step = min(scene.step for scene in scenes)
    there = [(scene, factor) for scene, factor in zip(scenes, factors, strict=True) if factor > 0.0]
    own = [march(scene.region, step, rays, shift).to(str(like.device)) for scene, _ in there]
    densities = [
        factor * scene.densities(samples.places) for (scene, factor), samples in zip(there, own, strict=True)
    ]
    union, slots = _union(own, count, like.device)
    total = like.new_zeros(len(union.rays))
    for slot, density in zip(slots, densities, strict=True):
        total[slot] += density
    weights = ray_weights(total * (SCALE * step), union)
    clock("decode")
    seen = weights > min(scene.threshold for scene in scenes)
    basis = harmonics_of(rays, like)
    features = like.new_zeros((len(total), 3))
    shares = _shares(slots, densities, len(total))
    for (scene, _), samples, slot, share in zip(there, own, slots, shares, strict=True):
        rows = seen[slot].nonzero()[:, 0]
        values = scene.features(samples.places[rows], samples.rays[rows], basis)[:, 0]
        features[slot[rows]] += values if len(there) == 1 else values * share[rows, None]
    kept = seen.nonzero()[:, 0]
    colors = features[kept].sigmoid() * weights[kept, None]
    picture = ray_sums(colors, union.rays[kept], count)
    alpha = ray_sums(weights[:, None], union.rays, count)[:, 0]
    clock("shade")
    return picture, alpha


def _union(own: Sequence[Samples], count: int, device: torch.device) -> tuple[Samples, list[Tensor]]:
    """Samples that any scene has, and where among them those of each scene are."""
    if len(own) == 1:
        return own[0], [torch.arange(len(own[0].rays), device=own[0].rays.device)]
    keys = [(one.rays.long() << 32) | one.numbers.long() for one in own]
    none = torch.empty(0, dtype=torch.int64, device=device)
    every, inverse = torch.unique(torch.cat([none, *keys]), return_inverse=True)
    rays = every >> 32
    first = torch.searchsorted(rays, torch.arange(count + 1, device=rays.device))
    samples = Samples(torch.empty((0, 3), device=device), rays.int(), (every & 0xFFFFFFFF).int(), first)
    return samples, list(inverse.split([len(one) for one in keys]))


def _shares(slots: Sequence[Tensor], densities: Sequence[Tensor], count: int) -> list[Tensor]:
    """Softmax over scenes of their densities at each sample."""
    if len(slots) < 2:
        return [torch.ones_like(one) for one in densities]
    most = densities[0].new_zeros(count)
    for slot, density in zip(slots, densities, strict=True):
        most[slot] = torch.maximum(most[slot], density)
    powers = [torch.exp(one - most[slot]) for slot, one in zip(slots, densities, strict=True)]
    total = torch.zeros_like(most)
    for slot, power in zip(slots, powers, strict=True):
        total[slot] += power
    return [power / total[slot] for slot, power in zip(slots, powers, strict=True)]
