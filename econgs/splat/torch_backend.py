"""The splatting core in plain PyTorch: the oracle of the tests, and the way without a compiled module.

Any floating dtype, any device, gradients by autograd. The arithmetic is the textbook's (EWA projection,
Zwicker et al. 2001; tiles and front-to-back blending, Kerbl et al. 2023), vectorised over the pixels and
Gaussians of a tile.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.econgs.splat.low_pass import LowPass
from econgs_bench.econgs.splat.rays import deepen, relative_depths
from econgs_bench.econgs.splat.splats import Splats

TILE = 16  # pixels
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
CLAMP = 1.3  # the Jacobian is taken no further out than this many half fields of view


class Projected(NamedTuple):
    """Gaussians on the image plane, in pixels; the inverse of the covariance is ``(c, -b, a) / det``.

    Attributes:
        share: factor on opacities; None for 1.
        ray: factor on optical depths, before that; None for 1.
    """

    u: Tensor
    v: Tensor
    depth: Tensor
    a: Tensor
    b: Tensor
    c: Tensor
    det: Tensor
    share: Tensor | None
    ray: Tensor | None

    def opacities(self, opacities: Tensor) -> Tensor:
        """Opacities of the middles, from those of the Gaussians."""
        if self.ray is not None:
            opacities = deepen(opacities, self.ray)
        return opacities if self.share is None else opacities * self.share


def rasterise(splats: Splats) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features H×W×C, alpha H×W, depth H×W and radii N."""
    means, quats, scales, opacities, features, camera, screen_offset, low_pass = splats
    with torch.no_grad():
        seen, radii, boxes = _visible(
            project(means, quats, scales, camera, screen_offset, low_pass), opacities, camera
        )
    # Everything differentiable is computed from the visible rows only: what is culled gets exact zeros
    # as gradients, whatever infinities its projection holds.
    offset = None if screen_offset is None else screen_offset[seen]
    visible = project(means[seen], quats[seen], scales[seen], camera, offset, low_pass)
    opacity = visible.opacities(opacities[seen])
    pairs, counts = _intersections(boxes, camera)
    columns = [visible.u, visible.v, visible.c / visible.det, -visible.b / visible.det]
    columns.append(visible.a / visible.det)
    geometry = torch.stack([*columns, opacity], dim=0)
    payload = torch.cat(
        [features[seen], visible.depth[:, None], torch.ones_like(visible.depth[:, None])], dim=1
    )

    pixels: list[Tensor] = []
    order: list[Tensor] = []
    per_tile = zip(
        geometry[:, pairs].split(counts, dim=1),
        payload[pairs].split(counts),
        _tiles(camera, means),
        strict=True,
    )
    for shapes, values, (index, x, y) in per_tile:
        order.append(index)
        pixels.append(_blend(shapes, values, x, y))
    position = torch.empty_like(torch.cat(order))
    position[torch.cat(order)] = torch.arange(position.numel(), device=means.device)
    image = torch.cat(pixels)[position].reshape(camera.height, camera.width, -1)
    return image[..., :-2], image[..., -1], image[..., -2], radii


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    camera: Camera,
    screen_offset: Tensor | None,
    low_pass: LowPass,
) -> Projected:
    """Gaussians as a camera sees them, those behind it too; smoothing is not added."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)
    view = pose[:3, :3]
    x, y, z = (means @ view.T + pose[:3, 3]).unbind(-1)

    slope_x, slope_y = _slopes(x, y, z, camera)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], dim=-1),
            torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], dim=-1),
        ],
        dim=-2,
    )
    # With M = J W R S the projected covariance is M Mᵀ + variance I. Its determinant is taken from the cross
    # product of M's rows (Cauchy-Binet): a c - b² cancels for needles.
    to_image = jacobian @ view
    turns = rotations(quats)
    first, second = (to_image @ turns * scales[:, None, :]).unbind(1)
    aa, cc = (first * first).sum(-1), (second * second).sum(-1)
    cross = torch.linalg.cross(first, second)
    before, variance = (cross * cross).sum(-1), low_pass.variance
    det = before + variance * (aa + cc) + variance * variance
    share = (before / det).sqrt() if low_pass.compensated else None
    ray = None
    if low_pass.ray_power:
        ray = _ray_factors(slope_x, slope_y, view, turns, scales, low_pass.ray_power)

    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    if screen_offset is not None:
        u, v = u + screen_offset[:, 0], v + screen_offset[:, 1]
    return Projected(u, v, z, aa + variance, (first * second).sum(-1), cc + variance, det, share, ray)


def ray_factors(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera, power: float) -> Tensor:
    """N factors on optical depths in a view; see ``ray_power`` of :class:`.econgs.splat.LowPass`."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)
    view = pose[:3, :3]
    x, y, z = (means @ view.T + pose[:3, 3]).unbind(-1)
    return _ray_factors(*_slopes(x, y, z, camera), view, rotations(quats), scales, power)


def _slopes(x: Tensor, y: Tensor, z: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Slopes of the rays on which the Jacobian is taken: clamped to a little outside the image."""
    limit_x = CLAMP * 0.5 * camera.width / camera.fx
    limit_y = CLAMP * 0.5 * camera.height / camera.fy
    return (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)


def _ray_factors(
    slope_x: Tensor, slope_y: Tensor, view: Tensor, turns: Tensor, scales: Tensor, power: float
) -> Tensor:
    direction = torch.stack([slope_x, slope_y, torch.ones_like(slope_x)], dim=1)
    direction = torch.nn.functional.normalize(direction, dim=1) @ view
    return relative_depths(torch.einsum("nij,ni->nj", turns, direction), scales) ** power


def rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of quaternions of any length but zero."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _visible(splats: Projected, opacities: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the visible Gaussians from near to far, the radii of all, and pixel boxes of the visible.

    The support is the ellipse on which alpha reaches 1/255; a Gaussian is visible if the ellipse's box holds
    a pixel centre. Boxes are inclusive: first and last column, first and last row.
    """
    opacities = splats.opacities(opacities)
    squared = 2.0 * torch.log(opacities / MIN_ALPHA).clamp(min=0)
    half_u, half_v = (squared * splats.a).sqrt(), (squared * splats.c).sqrt()
    lower = torch.stack([splats.u - half_u, splats.v - half_v], dim=-1) - 0.5
    upper = torch.stack([splats.u + half_u, splats.v + half_v], dim=-1) - 0.5
    last = torch.tensor([camera.width - 1, camera.height - 1], dtype=lower.dtype, device=lower.device)
    lower, upper = lower.ceil().clamp(min=0), torch.minimum(upper.floor(), last)
    # What overflows (an absurd scale) fails one of these comparisons and is culled.
    visible = (lower <= upper).all(-1) & (splats.depth > camera.near) & (opacities >= MIN_ALPHA)
    visible &= torch.isfinite(splats.det)

    middle = 0.5 * (splats.a + splats.c)
    spread = (0.25 * (splats.a - splats.c) ** 2 + splats.b**2).sqrt()
    radii = torch.where(visible, (3.0 * (middle + spread).sqrt()).ceil(), 0.0)
    seen = visible.nonzero()[:, 0]
    seen = seen[torch.argsort(splats.depth[seen], stable=True)]
    boxes = torch.cat([lower[seen], upper[seen]], dim=-1).long()[:, [0, 2, 1, 3]]
    return seen, radii.clamp(max=2**30).to(torch.int32), boxes


def _intersections(boxes: Tensor, camera: Camera) -> tuple[Tensor, list[int]]:
    """Which of the visible touch which tile: indices grouped by tile, near to far, and group sizes."""
    across, down = math.ceil(camera.width / TILE), math.ceil(camera.height / TILE)
    first_x, last_x, first_y, last_y = (boxes // TILE).unbind(-1)
    wide, high = last_x - first_x + 1, last_y - first_y + 1
    gaussian = torch.repeat_interleave(torch.arange(len(boxes), device=boxes.device), wide * high)
    starts = torch.cumsum(wide * high, 0) - wide * high
    nth = torch.arange(len(gaussian), device=boxes.device) - starts[gaussian]
    column = first_x[gaussian] + nth % wide[gaussian]
    row = first_y[gaussian] + nth // wide[gaussian]
    tile = row * across + column
    order = torch.argsort(tile, stable=True)
    return gaussian[order], torch.bincount(tile, minlength=across * down).tolist()


def _tiles(camera: Camera, like: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Per tile, the flat indices and the centres of its pixels."""
    index = torch.arange(camera.height * camera.width, device=like.device).reshape(
        camera.height, camera.width
    )
    blocks = [block for band in index.split(TILE, dim=0) for block in band.split(TILE, dim=1)]
    flat = [block.reshape(-1) for block in blocks]
    return [
        (one, (one % camera.width).to(like.dtype) + 0.5, (one // camera.width).to(like.dtype) + 0.5)
        for one in flat
    ]


def _blend(shapes: Tensor, values: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Composites the G Gaussians of one tile, near to far, over its P pixels: P×(C+2)."""
    if (
        len(values) == 0
    ):  # P×0 times 0×(C+2): zeros that still hang on the inputs, so that a backward pass runs
        return shapes[0].expand(len(x), 0) @ values
    u, v, conic_a, conic_b, conic_c, opacity = shapes
    dx, dy = x[:, None] - u, y[:, None] - v
    falloff = torch.exp(-0.5 * (conic_a * dx * dx + conic_c * dy * dy) - conic_b * dx * dy)
    alpha = (opacity * falloff).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha < MIN_ALPHA, 0.0, alpha)
    behind = torch.cumprod(1.0 - alpha, dim=1)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)
    # Transmittance never rises, so the first Gaussian that would take it under the limit ends the pixel.
    weights = torch.where(behind < MIN_TRANSMITTANCE, 0.0, alpha * before)
    return weights @ values
