"""Further losses of iVR-GS: normals as in the depth map, smooth coefficients."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera

_LEAST_ALPHA = 1e-3
_EPS = 1e-8


def depth_normals(depth: Tensor, alpha: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Unit normals of a depth map that face the camera, and where there are any.

    Args:
        depth: (H, W) sum of weights x depth, as rasterised.
        alpha: (H, W) sum of weights.
        camera: the view.

    Returns:
        (H, W, 3) normals in scene space, zero where there is none, and the (H, W) mask: pixels whose four
        neighbours all show something.
    """
    opaque = alpha > _LEAST_ALPHA
    mean = torch.where(opaque, depth / alpha.clamp(min=_LEAST_ALPHA), 0.0)
    u = (torch.arange(camera.width, device=depth.device) + 0.5 - camera.cx) / camera.fx
    v = (torch.arange(camera.height, device=depth.device) + 0.5 - camera.cy) / camera.fy
    points = torch.stack([u[None, :] * mean, v[:, None] * mean, mean], dim=-1).to(depth)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    inner = torch.linalg.cross(down, across)
    length = torch.linalg.vector_norm(inner, dim=-1, keepdim=True)
    mask = torch.zeros_like(opaque)
    mask[1:-1, 1:-1] = (
        opaque[1:-1, 2:] & opaque[1:-1, :-2] & opaque[2:, 1:-1] & opaque[:-2, 1:-1] & (length[..., 0] > 1e-12)
    )
    normals = torch.zeros_like(points)
    normals[1:-1, 1:-1] = inner / length.clamp(min=1e-12)
    rotation = torch.as_tensor(camera.camera_to_world[:3, :3], device=depth.device).to(depth)
    return torch.where(mask[..., None], normals @ rotation.T, 0.0), mask


def normal_loss(rendered: Tensor, depth: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Mean square of splatted normals less those of the depth map, weighted by alpha, where it has any.

    Args:
        rendered: (H, W, 3) splatted normals, premultiplied.
        depth: (H, W) as rasterised; constant here.
        alpha: (H, W) as rasterised; constant here.
        camera: the view.
    """
    normals, mask = depth_normals(depth.detach(), alpha.detach(), camera)
    difference = rendered - normals * alpha.detach()[..., None]
    return (difference.square() * mask[..., None]).sum() / (3 * mask.sum()).clamp(min=1)


def smoothness_loss(values: Tensor, image: Tensor) -> Tensor:
    """Mean absolute difference of neighbours, less where the image has an edge.

    Args:
        values: (H, W, C).
        image: (H, W, 3) true colors.
    """
    total = values.new_zeros(())
    for axis in (0, 1):
        edges = torch.exp(-image.diff(dim=axis).abs().mean(dim=-1, keepdim=True))
        total = total + (values.diff(dim=axis).abs() * edges).sum(dim=-1).mean()
    return total


def mean_over(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of (H, W, C) values where the (H, W) mask is."""
    return (values * mask[..., None]).sum() / (values.shape[-1] * mask.sum() + _EPS)
