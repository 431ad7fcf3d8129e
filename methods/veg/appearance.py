"""How a scene shows scalars: the look-up of its transfer function, and its light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from econgs_bench.datasets.scene import BasicScene, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.econgs.anchors.shading import shade
from econgs_bench.methods.shared.edits import triple

_PHONG = 4.0
"""Power of |n·h| over that of r·v for nearly the same highlight: the angle of n and h is half as wide."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """The look-up and the light of a scene.

    Attributes:
        table: (entries, 4) color and extinction per unit of scene space, at equidistant values.
        reference: length over which the transfer function states its opacities, scene units.
        coefficients: (4,) k_a, k_d, k_s and β of the scene's light; None: unshaded.
        toward: (3,) unit vector to the light; None for a headlight.
    """

    table: Tensor
    reference: float
    coefficients: Tensor | None
    toward: Tensor | None

    @classmethod
    def of(cls, scene: BasicScene, entries: int, device: str | torch.device) -> Appearance:
        """That of a scene with a transfer function."""
        assert scene.transfer is not None
        light = scene.light
        coefficients = toward = None
        if light is not None:
            power = light.shininess * (_PHONG if light.model == "phong" else 1.0)
            numbers = [light.ambient, light.diffuse, light.specular, power]
            coefficients = torch.tensor(numbers, dtype=torch.float32, device=device)
            if light.direction is not None:
                toward = torch.tensor(light.direction, dtype=torch.float32, device=device)
        table = torch.from_numpy(scene.transfer.table(entries)).to(device)
        return cls(table, scene.transfer.reference_length, coefficients, toward)

    def look_up(self, scalars: Tensor) -> Tensor:
        """(N, 4) color and extinction at (N,) scalars in [0, 1]; differentiable."""
        low, share = self._cells(scalars)
        below = self.table.index_select(0, low)
        return torch.addcmul(below, share[:, None], self.table.index_select(0, low + 1) - below)

    @torch.no_grad()
    def extinctions(self, scalars: Tensor) -> Tensor:
        """(N,) extinction at (N,) scalars in [0, 1]."""
        low, share = self._cells(scalars)
        column = self.table[:, 3]
        below = column.index_select(0, low)
        return torch.addcmul(below, share, column.index_select(0, low + 1) - below)

    def _cells(self, scalars: Tensor) -> tuple[Tensor, Tensor]:
        """Number of the entry at or below each value, and the share of the next one."""
        last = len(self.table) - 1
        place = scalars * last
        low = place.detach().long().clamp(0, last - 1)
        return low, place - low

    def shade(self, means: Tensor, normals: Tensor, colors: Tensor, factors: Tensor, eye: Tensor) -> Tensor:
        """(M, 3) shaded colors in [0, 1].

        Args:
            means: (M, 3).
            normals: (M, 3) of any length.
            colors: (M, 3) of the look-up.
            factors: (M, 4) on the light's coefficients.
            eye: (3,) camera centre.
        """
        if self.coefficients is None:
            return colors
        return shade(means, normals, colors, factors * self.coefficients, eye, self.toward)


def scene_as_json(scene: BasicScene) -> dict[str, Any]:
    """The definition of a scene with a transfer function as JSON values."""
    assert scene.transfer is not None
    return {
        "name": scene.name,
        "variable": scene.variable,
        "background": list(scene.background),
        "light": None if scene.light is None else asdict(scene.light),
        "transfer": asdict(scene.transfer),
    }


def scene_from_json(about: Mapping[str, Any]) -> BasicScene:
    """Inverse of :func:`scene_as_json`.

    Raises:
        ValueError, KeyError, TypeError: it describes no such scene.
    """
    light, transfer = about["light"], about["transfer"]
    bumps = tuple(Bump(**bump | {"color": triple(bump["color"])}) for bump in transfer["bumps"])
    if light is not None:
        direction = light["direction"]
        light = Light(**light | {"direction": None if direction is None else triple(direction)})
        if light.model not in ("blinn-phong", "phong"):
            raise ValueError(f"light of model {light.model!r}")
    scene = BasicScene(
        name=str(about["name"]),
        variable=str(about["variable"]),
        transfer=TransferFunction(str(transfer["name"]), bumps, float(transfer["reference_length"])),
        light=light,
        background=triple(about["background"]),
    )
    look = Appearance.of(scene, 2, "cpu")
    corners = [[b.start, b.rise, b.fall, b.end, b.opacity, *b.color] for b in bumps]
    numbers = [*scene.background, *np.ravel(corners)]
    for tensor in (look.table, look.coefficients, look.toward):
        numbers += [] if tensor is None else tensor.ravel().tolist()
    if not bumps or look.reference <= 0.0 or not np.isfinite([look.reference, *numbers]).all():
        raise ValueError("its transfer function, light or background is none")
    return scene
