"""A trained 3DGS representation: rendering, and the folder it is saved in."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import torch

from datasets.camera import Camera
from datasets.errors import DataError
from datasets.scene import RGB
from econgs.splat.composite import over, scale_depth
from econgs.splat.rasterise import rasterise
from econgs.splat.sh import spherical_harmonics
from methods.gaussian_splatting.ply import read_ply, write_ply
from methods.interface import Edit, Refused
from methods.shared.edits import opacity_factors
from methods.shared.files import saved_files
from methods.shared.model import ByScene, seconds

FORMAT = "econgs-bench 3dgs 1"
SH_REST = 15  # coefficients above the DC part, degree 3


@dataclass(frozen=True, eq=False)
class SceneGaussians:
    """The Gaussians of one scene as they are optimised and stored.

    Attributes:
        name: of the scene.
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


@dataclass(frozen=True, eq=False)
class _Activated:
    """What a frame needs of the scenes rendered together, ready for the rasteriser."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh_dc: torch.Tensor
    sh_rest: torch.Tensor
    sh_degree: int

    @classmethod
    def of(cls, scenes: Sequence[SceneGaussians]) -> _Activated:
        return cls(
            means=torch.cat([s.means for s in scenes]),
            quats=torch.nn.functional.normalize(torch.cat([s.quats for s in scenes]), dim=1),
            scales=torch.cat([s.log_scales for s in scenes]).exp(),
            opacities=torch.cat([s.logits for s in scenes]).sigmoid(),
            sh_dc=torch.cat([s.sh_dc for s in scenes]),
            sh_rest=torch.cat([s.sh_rest for s in scenes]),
            sh_degree=max(s.sh_degree for s in scenes),
        )


class SplatModel(ByScene[SceneGaussians]):
    """Gaussians of one or several scenes, rendered separately or concatenated and sorted once.

    Args:
        scenes: at least one, with distinct names, on one device.
    """

    method = "3dgs"
    """Name of the method, for messages."""

    def __init__(self, scenes: Sequence[SceneGaussians]) -> None:
        super().__init__((scene.name, scene) for scene in scenes)
        self._activated: tuple[tuple[str, ...], _Activated] | None = None

    def gaussians(self, scene: str) -> SceneGaussians:
        """The stored Gaussians of one scene.

        Raises:
            UnknownName: it does not hold that scene.
        """
        return self._find(scene)

    def primitives(self, scene: str | None = None) -> int:
        """Number of Gaussians of one scene or of all."""
        names = self.scenes if scene is None else (scene,)
        return sum(len(self.gaussians(name).means) for name in names)

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Render scenes together; see :class:`methods.interface.Model`.

        Raises:
            Refused: an edit of anything but opacity.
            UnknownName: it does not hold such a scene.
        """
        names = self.scenes if scenes is None else tuple(scenes)
        back = self.gaussians(names[0]).background if background is None else background
        with torch.inference_mode():
            ready = self._ready(names)
            opacities = self._edited(ready.opacities, names, edit)
            colors = _shade(ready, camera)
            splats = rasterise(ready.means, ready.quats, ready.scales, opacities, colors, camera)
            rgb = over(splats.features, splats.alpha, back)
            return rgb.clamp_(0.0, 1.0), splats.alpha.clamp(0.0, 1.0)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part.

        "decode" is 0: loading activates the attributes once, so that no frame pays for it.
        """
        with torch.inference_mode():
            ready = self._ready(self.scenes if scenes is None else tuple(scenes))
            times = [seconds(ready.means)]
            colors = _shade(ready, camera)
            times.append(seconds(ready.means))
            rasterise(ready.means, ready.quats, ready.scales, ready.opacities, colors, camera)
            times.append(seconds(ready.means))
        return {"decode": 0.0, "shade": times[1] - times[0], "rasterise": times[2] - times[1]}

    def _ready(self, names: tuple[str, ...]) -> _Activated:
        """Activated attributes of these scenes, kept for the next frame."""
        if self._activated is None or self._activated[0] != names:
            self._activated = names, _Activated.of([self.gaussians(name) for name in names])
        return self._activated[1]

    def _edited(
        self, opacities: torch.Tensor, names: tuple[str, ...], edit: Mapping[str, Edit] | None
    ) -> torch.Tensor:
        wanted = opacity_factors(self.method, names, edit)
        factors = [wanted.get(name) for name in names]
        if all(factor is None for factor in factors):
            return opacities
        sizes = [self.primitives(name) for name in names]
        pieces = [
            o if factor is None else scale_depth(o, factor)
            for o, factor in zip(opacities.split(sizes), factors, strict=True)
        ]
        return torch.cat(pieces)


class GaussianModel(SplatModel):
    """A model of 3DGS: every attribute in float32."""

    def bytes_estimate(self) -> int:
        """Bytes of the Gaussians; headers and metadata add a few hundred."""
        return sum(scene.rows().nbytes for scene in self._scenes.values())

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.ply`` and ``<scene>.json`` (background, degree) per scene.

        Raises:
            Refused: ``rate`` is given; this method has one size.
        """
        if rate is not None:
            raise Refused("3dgs has no rate knob")
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
            parts["metadata"] = (folder / f"{stem}.json").write_bytes(json.dumps(about).encode())
            ledger[name] = parts
        return ledger


def load_model(folder: Path, device: str) -> GaussianModel:
    """Read what :meth:`GaussianModel.save` wrote.

    Raises:
        DataError: a file is missing, damaged or of another kind.
    """
    return GaussianModel([_load_scene(file, device) for file in saved_files(folder, ".json", "3dgs")])


def _load_scene(file: Path, device: str) -> SceneGaussians:
    try:
        about = json.loads(file.read_bytes())
        if about["format"] != FORMAT:
            raise ValueError(f"format {about['format']!r} instead of {FORMAT!r}")
        name, degree = str(about["scene"]), int(about["sh_degree"])
        red, green, blue = (float(value) for value in about["background"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"not the metadata of a 3dgs scene ({error})"
        raise DataError(file, reason, "Save the model again") from error
    if not 0 <= degree <= 3:
        raise DataError(file, f"SH degree {degree}", "Save the model again")
    rows = read_ply(file.with_suffix(".ply"))
    return SceneGaussians.from_rows(name, (red, green, blue), degree, rows, device)


def _shade(ready: _Activated, camera: Camera) -> torch.Tensor:
    position = torch.as_tensor(camera.position, dtype=ready.means.dtype, device=ready.means.device)
    return spherical_harmonics(ready.sh_degree, ready.means, position, ready.sh_dc, ready.sh_rest)
