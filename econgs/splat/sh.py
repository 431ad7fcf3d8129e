"""View-dependent color by real spherical harmonics, in the convention of the 3DGS lineage."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.econgs.splat.rasterise import choose_backend, native

MAX_DEGREE = 3


def spherical_harmonics(
    degree: int,
    means: Tensor,
    camera_position: Tensor,
    coefficients: Tensor,
    rest: Tensor | None = None,
    *,
    backend: str | None = None,
) -> Tensor:
    """Colors ``max(0, 0.5 + Σ cₖ Yₖ(d))`` with d the unit direction from the camera to each mean.

    Real spherical harmonics with the Condon-Shortley phase, ordered (0,0), (1,-1), (1,0), (1,1), (2,-2), …
    Differentiable with respect to ``means``, ``coefficients`` and ``rest``.

    Args:
        degree: 0 to 3; coefficients of higher degrees present are not used (the schedule of 3DGS raises it).
        means: (N, 3).
        camera_position: (3,).
        coefficients: (N, K, 3) with K ≥ (degree + 1)²; or only the first, (N, 1, 3), where ``rest`` is given.
        rest: (N, K - 1, 3), the others: two tensors with learning rates of their own need not be joined.
        backend: as in :func:`.econgs.splat.rasterise`.

    Returns:
        (N, 3) colors, ≥ 0.

    Raises:
        ValueError: a degree or shape out of range.
    """
    needed = (degree + 1) ** 2
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree}: 0 to {MAX_DEGREE} are possible")
    for name, one in (("coefficients", coefficients), ("rest", rest)):
        if one is not None and (one.ndim != 3 or one.shape[0] != means.shape[0] or one.shape[2] != 3):
            raise ValueError(f"{name} has shape {tuple(one.shape)}, not ({len(means)}, K, 3)")
    if rest is not None and coefficients.shape[1] != 1:
        raise ValueError(f"coefficients has shape {tuple(coefficients.shape)}, not (N, 1, 3), beside rest")
    available = coefficients.shape[1] + (0 if rest is None else rest.shape[1])
    if available < needed:
        raise ValueError(f"degree {degree} needs {needed} coefficients, not {available}")
    if degree == 0:
        rest = None  # no gradient either: an optimiser leaves it alone
    camera_position = torch.as_tensor(camera_position, dtype=means.dtype, device=means.device)
    if choose_backend(means, backend) == "native":
        colors: Tensor = native().spherical_harmonics(degree, means, camera_position, coefficients, rest)
        return colors
    if rest is not None:
        coefficients = torch.cat([coefficients, rest[:, : needed - 1]], dim=1)
    if degree == 0:  # no direction enters, so none is computed
        return (0.5 + 0.28209479177387814 * coefficients[:, 0]).clamp(min=0)
    basis = harmonics(degree, torch.nn.functional.normalize(means - camera_position, dim=-1))
    return (0.5 + (basis[:, :, None] * coefficients[:, : basis.shape[1]]).sum(1)).clamp(min=0)


def harmonics(degree: int, direction: Tensor) -> Tensor:
    """(N, (degree+1)²) real spherical harmonics of unit vectors; constants √((2l+1)/4π · …) in decimals."""
    x, y, z = direction.unbind(-1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)
