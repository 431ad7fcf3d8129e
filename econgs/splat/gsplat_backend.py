"""The splatting core on CUDA, through gsplat's documented functions (1.4 and later).

The three steps of ``gsplat.rasterization`` (project, intersect tiles, rasterise) run one by one:
between the first two, the screen offset is added, and the extents become those on which alpha reaches 1/255,
which gsplat cuts at 3 or 3.33 σ by its version. Two rules differ from the other backends: alpha stops at
0.999, not 0.99; and with an off-centre principal point the Jacobian is clamped 0.3 half fields of view
outside each image edge, not 1.3 of them from the axis.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.splat.rays import deepen
from econgs_bench.econgs.splat.splats import Splats
from econgs_bench.econgs.splat.torch_backend import ray_factors

TILE = 16


def rasterise(splats: Splats) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features H×W×C, alpha H×W, depth H×W and radii N."""
    import gsplat

    means, quats, scales, opacities, features, camera, screen_offset, low_pass = splats
    width, height = camera.width, camera.height
    if len(means) == 0:
        # Zeros with a gradient path to the inputs, for a backward pass.
        offsets = [] if screen_offset is None else [screen_offset]
        rest = torch.cat([means, quats, scales, opacities[:, None], *offsets], dim=1)
        nothing = torch.cat([features, rest.sum(1, keepdim=True)], dim=1).sum(0)
        image = nothing.expand(height, width, -1)
        return image[..., :-1], image[..., -1], image[..., -1], means.new_zeros(0, dtype=torch.int32)
    pose = torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)
    intrinsics = means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    radii, centres, depths, conics, shares = gsplat.fully_fused_projection(
        means, None, quats, scales, pose[None], intrinsics[None], width, height,
        eps2d=low_pass.variance, near_plane=camera.near, calc_compensations=low_pass.compensated,
    )  # fmt: skip
    if low_pass.ray_power:
        opacities = deepen(opacities, ray_factors(means, quats, scales, camera, low_pass.ray_power))
    if low_pass.compensated:
        opacities = opacities * shares[0]
    if screen_offset is not None:
        centres = centres + screen_offset[None]

    with torch.no_grad():
        extents, radius = _extents(radii, centres, conics, opacities, camera)
    # 1.4 takes one radius per Gaussian, later versions one per axis.
    per_axis = radii.ndim == 3
    across, down = math.ceil(width / TILE), math.ceil(height / TILE)
    _, ids, flat = gsplat.isect_tiles(
        centres.detach(), extents if per_axis else extents.amax(-1), depths.detach(), TILE, across, down
    )
    offsets = gsplat.isect_offset_encode(ids, 1, across, down)

    payload = torch.cat([features[None], depths[..., None]], dim=-1)
    image, alpha = gsplat.rasterize_to_pixels(
        centres, conics, payload, opacities[None], width, height, TILE, offsets.reshape(1, down, across), flat
    )
    return image[0, ..., :-1], alpha[0, ..., 0], image[0, ..., -1], radius


def _extents(
    radii: Tensor, centres: Tensor, conics: Tensor, opacities: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Half-extents of the supports (1, N, 2), zero where unseen, and ⌈3 σ⌉ of the longer axis (N)."""
    a, b, c = conics[0].unbind(-1)
    determinant = a * c - b * b
    variance = torch.stack([c, a], dim=-1) / determinant[:, None]
    reach = 2.0 * torch.log(255.0 * opacities).clamp(min=0)
    extent = (reach[:, None] * variance).sqrt()
    size = centres.new_tensor([camera.width, camera.height])
    inside = ((centres[0] + extent > 0) & (centres[0] - extent < size)).all(-1)
    visible = (radii.reshape(1, len(a), -1) > 0).any(-1)[0] & inside & (opacities * 255.0 >= 1.0)

    middle = 0.5 * (a + c)
    spread = (0.25 * (a - c) ** 2 + b * b).sqrt()
    longest = ((middle + spread) / determinant).sqrt()
    far = torch.finfo(extent.dtype).max
    extent = torch.where(visible[:, None], extent.ceil(), 0.0).nan_to_num(0.0, far, 0.0)
    radius = torch.where(visible, (3.0 * longest).ceil(), 0.0).nan_to_num(0.0, far, 0.0)
    return extent.clamp(max=2**20).int()[None], radius.clamp(max=2**30).int()
