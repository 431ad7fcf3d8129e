"""Blinn-Phong shading of Gaussians in a float-safe form (ECoNGS, equations of the three color terms)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from econgs_bench.econgs.splat.rasterise import choose_backend

MIN_NORMAL = 1e-3  # least divisor of a normal (iVR-GS)
MIN_LENGTH = 1e-6  # shorter vectors have no direction: zero, without a gradient
MIN_BASE = 1e-6  # least base of the power: the derivative of 0 ** shininess is NaN
MAX_SPECULAR = 5.0
MAX_SHININESS = 50.0


def raw_specular(coefficient: float) -> float:
    """The value before activation, sigmoid × ``MAX_SPECULAR``, of a specular coefficient."""
    return math.log(coefficient / (MAX_SPECULAR - coefficient))


@dataclass(frozen=True)
class Factors:
    """Edits of a scene: factors on its trained values.

    Attributes:
        opacity: factor on optical depths: an opacity o becomes 1 - (1 - o)^factor.
        ambient, diffuse, specular, shininess: factors on k_a, k_d, k_s and β.

    Raises:
        ValueError: a factor that is negative or not finite.
    """

    opacity: float = 1.0
    ambient: float = 1.0
    diffuse: float = 1.0
    specular: float = 1.0
    shininess: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"the factor on {name} is {value}; it must be finite and at least 0")

    def on(self, coefficients: Tensor) -> Tensor:
        """(M, 4) k_a, k_d, k_s and β of Gaussians after the edit."""
        by = [self.ambient, self.diffuse, self.specular, self.shininess]
        return coefficients if by == [1.0] * 4 else coefficients * coefficients.new_tensor(by)


def unit(vectors: Tensor) -> Tensor:
    """Vectors of length 1; those shorter than ``MIN_LENGTH`` become zero."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    long = length > MIN_LENGTH
    return torch.where(long, vectors / torch.where(long, length, 1.0), 0.0)


def shade(
    means: Tensor,
    normals: Tensor,
    base: Tensor,
    coefficients: Tensor,
    eye: Tensor,
    light: Tensor | None,
    backend: str | None = None,
) -> Tensor:
    """(M, 3) colors of Gaussians, in [0, 1].

    With v the unit vector to the camera, l to the light and h half-way between them:
    base · (k_a + k_d |n·l|), plus k_s |n·h|^β in white wherever n·l is not 0. (The paper writes v from the
    camera to the Gaussian, which would cancel the light's direction under a headlight.)

    Args:
        means: (M, 3).
        normals: (M, 3) of any length; see ``MIN_NORMAL``.
        base: (M, 3) palette color + offset color.
        coefficients: (M, 4) k_a, k_d, k_s, β.
        eye: (3,) camera centre.
        light: (3,) unit vector to the light; None: a headlight, l = h = v.
        backend: "native" or "torch", as in :func:`.econgs.splat.rasterise`; native has no gradients and is
            not chosen where any are asked for.
    """
    learns = torch.is_grad_enabled() and any(
        one.requires_grad for one in (means, normals, base, coefficients)
    )
    if not learns and choose_backend(means, backend) == "native":
        from econgs_bench.econgs.anchors import native_shading

        return native_shading.shade(means, normals, base, coefficients, eye, light)
    length = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    normals = normals / length.clamp_min(MIN_NORMAL)
    view = unit(eye - means)
    half = view if light is None else unit(view + light)
    toward = (normals * (view if light is None else light)).sum(-1)
    ambient, diffuse, specular, shininess = coefficients.unbind(-1)
    peak = (normals * half).sum(-1).abs().clamp_min(MIN_BASE) ** shininess
    highlight = torch.where(toward != 0.0, specular * peak, 0.0)
    color = base * (ambient + diffuse * toward.abs())[:, None] + highlight[:, None]
    return color.clamp(0.0, 1.0)
