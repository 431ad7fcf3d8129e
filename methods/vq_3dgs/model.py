"""A trained vq-3dgs representation: the renderer of 3DGS on decoded codebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from econgs_bench.econgs.codebooks import quantise, quantise_scalars
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.methods.formats.integer import CELL
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians, SplatModel
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.quantised_scene import Column, QuantisedScene, placed, read_folder
from econgs_bench.methods.vq_3dgs.spec import VqOptions

FORMAT = "econgs-bench vq-3dgs 1"
GROUPS = {"color": 3, "sh1": 9, "sh2": 15, "sh3": 21, "scale": 3, "rotation": 4}
"""The factors of the product: group of attributes with one id -> numbers per Gaussian."""
WIDTHS = {"opacity": 1, **GROUPS}
OPACITIES = 256


def grouped(scene: SceneGaussians) -> dict[str, Tensor]:
    """(N, width) values of each group of attributes."""
    count = len(scene.means)
    quats = torch.nn.functional.normalize(scene.quats, dim=1)
    rest = scene.sh_rest.reshape(count, 45)
    return {
        "color": scene.sh_dc.reshape(count, 3),
        "sh1": rest[:, :9],
        "sh2": rest[:, 9:24],
        "sh3": rest[:, 24:],
        "scale": scene.log_scales,
        "rotation": torch.where(quats[:, :1] < 0, -quats, quats),  # both are the same rotation
    }


def quantised(scene: SceneGaussians, options: VqOptions, seed: int) -> QuantisedScene:
    """Codebooks of the Gaussians that can be seen at all."""
    size, stages = options.codebook_size, options.stages
    rows = (scene.logits.sigmoid() >= MIN_ALPHA).nonzero()[:, 0]
    share = CELL if options.positions == "coded" else None
    order, positions, grid = placed(scene.means[rows], scene.log_scales[rows], share)
    rows, positions = rows[order.to(rows.device)], positions.to(rows.device)
    columns: dict[str, Column] = {"opacity": (quantise_scalars(scene.logits[rows], OPACITIES, seed),)}
    for name, values in grouped(scene).items():
        columns[name] = quantise(values[rows], size, seed, stages)
    about = {"codebook size": size, "sh degree": scene.sh_degree}
    return QuantisedScene(scene.name, scene.background, about, positions, columns, "entropy", grid)


def gaussians(coded: QuantisedScene) -> SceneGaussians:
    """The Gaussians of a coded scene; differentiable with respect to the words."""
    count = len(coded.positions)
    rest = torch.cat([coded.column(name, WIDTHS[name]) for name in ("sh1", "sh2", "sh3")], dim=1)
    return SceneGaussians(
        name=coded.name,
        background=coded.background,
        sh_degree=int(str(coded.about["sh degree"])),
        means=coded.positions,
        log_scales=coded.column("scale", 3),
        quats=coded.column("rotation", 4),
        logits=coded.column("opacity", 1)[:, 0],
        sh_dc=coded.column("color", 3).reshape(count, 1, 3),
        sh_rest=rest.reshape(count, 15, 3),
    )


class VqModel(SplatModel):
    """Scenes of decoded codebooks.

    Args:
        stored: the scenes; none while they are not quantised yet.
        rendered: Gaussians of each scene.
        device: where.
    """

    method = "vq-3dgs"

    def __init__(
        self, stored: Sequence[QuantisedScene], rendered: Sequence[SceneGaussians], device: str
    ) -> None:
        super().__init__(rendered)
        self.stored, self.device = tuple(stored), device

    @classmethod
    def of(cls, stored: Sequence[QuantisedScene], device: str) -> VqModel:
        """A model of coded scenes."""
        with torch.no_grad():
            return cls(stored, [_on(gaussians(coded), device) for coded in stored], device)

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.safetensors`` per scene.

        Raises:
            Refused: it is not quantised yet.
        """
        if not self.stored:
            raise Refused("vq-3dgs is quantised in the last part of a fit only")
        return {coded.name: coded.write(folder, FORMAT) for coded in self.stored}

    @classmethod
    def load(cls, folder: Path, device: str) -> VqModel:
        read = read_folder(folder, "vq-3dgs", FORMAT, WIDTHS, partial(_checked, device=device))
        return cls([coded for coded, _ in read], [ready for _, ready in read], device)

    @classmethod
    def join(cls, models: Sequence[VqModel]) -> VqModel:
        stored = [scene for model in models for scene in model.stored]
        return cls(stored, [model.scene(name) for model in models for name in model.scenes], models[0].device)


def _on(scene: SceneGaussians, device: str) -> SceneGaussians:
    tensors = {name: v.to(device) for name, v in vars(scene).items() if isinstance(v, Tensor)}
    return SceneGaussians(scene.name, scene.background, scene.sh_degree, **tensors)


def _checked(coded: QuantisedScene, device: str) -> SceneGaussians:
    degree, size = coded.about["sh degree"], coded.about["codebook size"]
    if not isinstance(degree, int) or not 0 <= degree <= 3 or not isinstance(size, int):
        raise ValueError(f"SH degree {degree}, codebooks of {size} words")
    ready = _on(gaussians(coded), device)
    if not bool((ready.quats.square().sum(1) > 0).all()):
        raise ValueError("a rotation is zero")
    if not bool(torch.isfinite(ready.log_scales.exp()).all()):
        raise ValueError("a scale is not finite")
    return ready
