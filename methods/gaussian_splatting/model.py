"""A trained 3DGS representation: rendering, and the folder it is saved in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.gaussian_splatting.ply import read_ply, write_ply
from econgs_bench.methods.interface import Edit
from econgs_bench.methods.shared.edits import opacity_factor, triple
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.model import SceneModel
from econgs_bench.methods.shared.sealed import read_facts, write_facts

FORMAT = "econgs-bench 3dgs 1"
SH_REST = 15  # coefficients above the DC part, degree 3


@dataclass(frozen=True, eq=False)
class SceneGaussians:
    """The Gaussians of one scene as they are optimised and stored.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        sh_degree: highest degree in use; coefficients above it are zero.
        means: (N, 3).
        log_scales: (N, 3), natural logarithm of standard deviations.
        quats: (N, 4), w x y z, not necessarily normalised.
        logits: (N,), opacity before the sigmoid.
        sh_dc: (N, 1, 3), sh_rest: (N, 15, 3).
    """

    name: str
    background: RGB
    sh_degree: int
    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    logits: torch.Tensor
    sh_dc: torch.Tensor
    sh_rest: torch.Tensor

    def __len__(self) -> int:
        return len(self.means)

    def rows(self) -> np.ndarray:
        """(N, 62) float32 in the order of the PLY; f_rest is channel-major."""
        n = len(self.means)
        rest = self.sh_rest.transpose(1, 2).reshape(n, 3 * SH_REST)
        columns = [self.means, torch.zeros_like(self.means), self.sh_dc[:, 0], rest]
        columns += [self.logits[:, None], self.log_scales, self.quats]
        return torch.cat(columns, dim=1).detach().cpu().numpy()

    @classmethod
    def from_rows(
        cls, name: str, background: RGB, sh_degree: int, rows: np.ndarray, device: str
    ) -> SceneGaussians:
        table = torch.from_numpy(rows).to(device)
        n = len(table)
        return cls(
            name=name,
            background=background,
            sh_degree=sh_degree,
            means=table[:, 0:3].contiguous(),
            log_scales=table[:, 55:58].contiguous(),
            quats=table[:, 58:62].contiguous(),
            logits=table[:, 54].contiguous(),
            sh_dc=table[:, None, 6:9].contiguous(),
            sh_rest=table[:, 9:54].reshape(n, 3, SH_REST).transpose(1, 2).contiguous(),
        )


class SplatModel(SceneModel[SceneGaussians]):
    """Gaussians of 3DGS, as the methods that begin like it render them too."""

    method = "3dgs"
    preparation = "shade"

    def __init__(self, scenes: Iterable[SceneGaussians]) -> None:
        super().__init__(scenes)
        self._activated: dict[str, tuple[torch.Tensor, ...]] = {}

    def gaussians(self, scene: SceneGaussians, camera: Camera, edit: Edit) -> Gaussians:
        """Activated attributes, which are kept for the next frame, and the colors of a view."""
        factor = opacity_factor(self.method, scene.name, edit)
        if scene.name not in self._activated:
            quats = torch.nn.functional.normalize(scene.quats, dim=1)
            self._activated[scene.name] = quats, scene.log_scales.exp(), scene.logits.sigmoid()
        quats, scales, opacities = self._activated[scene.name]
        position = torch.as_tensor(camera.position, dtype=scene.means.dtype, device=scene.means.device)
        colors = spherical_harmonics(scene.sh_degree, scene.means, position, scene.sh_dc, scene.sh_rest)
        return Gaussians(scene.means, quats, scales, scale_depth(opacities, factor), colors)


class GaussianModel(SplatModel):
    """A model of 3DGS: every attribute in float32."""

    def bytes_estimate(self) -> int:
        """Bytes of the Gaussians; headers and metadata add a few hundred."""
        return sum(scene.rows().nbytes for scene in self._scenes.values())

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.ply`` and ``<scene>.json`` (background, degree) per scene."""
        ledger: dict[str, dict[str, int]] = {}
        for name, scene in self._scenes.items():
            stem = quote(name, safe=" ")
            parts = write_ply(folder / f"{stem}.ply", scene.rows())
            about = {
                "format": FORMAT,
                "scene": name,
                "background": list(scene.background),
                "sh_degree": scene.sh_degree,
            }
            parts["metadata"] = write_facts(folder / f"{stem}.json", about)
            ledger[name] = parts
        return ledger

    @classmethod
    def load(cls, folder: Path, device: str) -> GaussianModel:
        return cls(_load_scene(file, device) for file in saved_files(folder, ".json", "3dgs"))


def _load_scene(file: Path, device: str) -> SceneGaussians:
    try:
        about = read_facts(file, FORMAT)
        name, degree = str(about["scene"]), int(about["sh_degree"])
        background = triple(about["background"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"not the metadata of a 3dgs scene ({error})"
        raise DataError(file, reason, "Save the model again") from error
    if not 0 <= degree <= 3:
        raise DataError(file, f"SH degree {degree}", "Save the model again")
    rows = read_ply(file.with_suffix(".ply"))
    return SceneGaussians.from_rows(name, background, degree, rows, device)
