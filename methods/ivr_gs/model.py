"""A trained iVR-GS representation: Gaussians shaded by Blinn-Phong, edited, composed, and saved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.anchors.decoders import OFFSET_COLORS, OffsetColor
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.anchors.shading import MAX_SHININESS, MAX_SPECULAR, Factors, shade
from econgs_bench.econgs.codebooks import quantise_scalars
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.methods.formats.integer import CELL
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.ivr_gs.spec import IvrOptions
from econgs_bench.methods.shared.edits import Direction, shading_edit, triple
from econgs_bench.methods.shared.model import SceneModel
from econgs_bench.methods.shared.quantised_scene import (
    Column,
    QuantisedScene,
    half_exact,
    placed,
    read_folder,
)
from econgs_bench.methods.shared.training import SceneLabel

FORMAT = "econgs-bench ivr-gs 1"
METHOD = "ivr-gs"
WIDTHS = {
    "opacity": 1,
    "scale": 3,
    "rotation real": 1,
    "rotation imaginary": 3,
    "normal": 3,
    "offset color": 3,
    "ambient": 1,
    "diffuse": 1,
    "specular": 1,
    "shininess": 1,
}
"""The ten attributes that may have a codebook -> numbers per Gaussian; positions never have one.

Columns hold values before their activation, which is applied once, when a model is made ready to render.
"""
_SEED = 0  # scalar codebooks start from quantiles: no choice depends on it


@dataclass(frozen=True, eq=False)
class ShadedGaussians:
    """A scene, ready to render.

    Attributes:
        name, background: the scene's.
        light: unit vector to its directional light, or None for a headlight.
        palette: (3,) its palette color.
        means: (N, 3).
        scales: (N, 3) standard deviations.
        quats: (N, 4), w x y z.
        opacities: (N,) in [0, 1].
        normals: (N, 3) of any length.
        offsets: (N, 3) offset colors, which the palette color is added to, in [0, 1] or (-1, 1).
        coefficients: (N, 4) k_a, k_d, k_s and β.
    """

    name: str
    background: RGB
    light: Direction | None
    palette: Tensor
    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    normals: Tensor
    offsets: Tensor
    coefficients: Tensor

    def __len__(self) -> int:
        return len(self.means)

    def colors(self, eye: Tensor, palette: Tensor, light: Direction | None, factors: Factors) -> Tensor:
        """(N, 3) shaded colors, seen from ``eye``."""
        toward = None if light is None else self.means.new_tensor(light)
        base, coefficients = palette + self.offsets, factors.on(self.coefficients)
        return shade(self.means, self.normals, base, coefficients, eye, toward)


def activated(raw: Mapping[str, Tensor], offset_color: OffsetColor) -> dict[str, Tensor]:
    """Fields of :class:`ShadedGaussians` from columns; differentiable."""
    quats = torch.cat([raw["rotation real"], raw["rotation imaginary"]], dim=1)
    return {
        "scales": raw["scale"].exp(),
        "quats": torch.nn.functional.normalize(quats, dim=1),
        "opacities": raw["opacity"][:, 0].sigmoid(),
        "normals": raw["normal"],
        "offsets": OFFSET_COLORS[offset_color](raw["offset color"]),
        "coefficients": torch.cat(
            [
                raw["ambient"],
                raw["diffuse"],
                MAX_SPECULAR * raw["specular"].sigmoid(),
                MAX_SHININESS * raw["shininess"].sigmoid(),
            ],
            dim=1,
        ),
    }


def attributes_with_codebooks(text: str) -> frozenset[str]:
    """The attributes that the option ``quantised`` names.

    Raises:
        Refused: it names something else.
    """
    if text in ("all", "none"):
        return frozenset(WIDTHS if text == "all" else ())
    names = frozenset(name.strip().replace("_", " ") for name in text.split("+"))
    wrong = names - set(WIDTHS)
    if wrong:
        raise Refused(
            f"quantised={text}: {sorted(wrong)[0]!r} is none of all, none, {', '.join(WIDTHS)} (joined by +)"
        )
    return names


@dataclass(frozen=True, eq=False)
class Stored:
    """A scene as it is saved: quantised already, and what it was before, for saving at other sizes.

    Attributes:
        coded: at the default codebook size.
        raw: column -> (N, width) values that were learned, on the CPU; None where a file was read, which has
            one size.
        with_codebooks: names of columns that have one.
    """

    coded: QuantisedScene
    raw: Mapping[str, Tensor] | None
    with_codebooks: frozenset[str]

    @classmethod
    def of(
        cls,
        label: SceneLabel,
        palette: Sequence[float],
        means: Tensor,
        raw: Mapping[str, Tensor],
        options: IvrOptions,
    ) -> Stored:
        """Positions and codebooks of what was learned.

        Args:
            label: of the scene.
            palette: its palette color.
            means: (N, 3).
            raw: column -> (N, width) values.
            options: of the fit.
        """
        light = None if label.light is None else list(label.light)
        about: dict[str, object] = {"light": light, "palette": list(palette)}
        if options.offset_color != "sigmoid":
            about["offset color"] = options.offset_color
        share = CELL if options.positions == "coded" else None
        order, positions, grid = placed(means, raw["scale"], share)
        raw = {name: values.detach().cpu()[order] for name, values in raw.items()}
        bare = QuantisedScene(label.name, label.background, about, positions, {}, "fixed", grid)
        with_codebooks = attributes_with_codebooks(options.quantised)
        return cls(_coded(bare, raw, with_codebooks, options.codebook_size), raw, with_codebooks)

    def at(self, size: float | None) -> QuantisedScene:
        """The scene with codebooks of another size; the default's where it is None."""
        if size is None:
            return self.coded
        if self.raw is None:
            raise Refused("ivr-gs saves a model that was loaded at the codebook size that it has")
        if size != int(size) or not 1 <= size <= 65536:
            raise Refused(f"ivr-gs has no codebooks of {size:g} words: 1 to 65536")
        return _coded(self.coded, self.raw, self.with_codebooks, int(size))


def _coded(
    scene: QuantisedScene, raw: Mapping[str, Tensor], with_codebooks: frozenset[str], size: int
) -> QuantisedScene:
    columns: dict[str, Column] = {}
    for name in WIDTHS:
        values = raw[name]
        book = name in with_codebooks
        columns[name] = (quantise_scalars(values, size, _SEED),) if book else half_exact(values)
    return replace(scene, columns=columns)


def ready(coded: QuantisedScene, device: str) -> ShadedGaussians:
    """The scene, ready to render."""
    raw = {name: coded.column(name, width).to(device) for name, width in WIDTHS.items()}
    palette, light = cast("Sequence[float]", coded.about["palette"]), coded.about["light"]
    offset_color = cast("OffsetColor", coded.about.get("offset color", "sigmoid"))  # older files name none
    return ShadedGaussians(
        name=coded.name,
        background=coded.background,
        light=None if light is None else triple(cast("Sequence[float]", light)),
        palette=torch.tensor([float(value) for value in palette], device=device),
        means=coded.positions.to(device),
        **activated(raw, offset_color),
    )


class IvrModel(SceneModel[ShadedGaussians]):
    """Scenes of shaded Gaussians; codebooks are decoded when they are loaded.

    Args:
        scenes: at least one, with distinct names, on one device.
        stored: the same scenes as they are saved; None while training is under way.
    """

    method = METHOD
    preparation = "shade"

    def __init__(self, scenes: Sequence[ShadedGaussians], stored: Sequence[Stored] | None) -> None:
        super().__init__(scenes)
        self.stored = stored

    def gaussians(self, scene: ShadedGaussians, camera: Camera, edit: Edit) -> Gaussians:
        """The scene shaded for a view."""
        eye = torch.as_tensor(camera.position, dtype=scene.means.dtype, device=scene.means.device)
        palette, light, factors = shading_edit(scene.name, scene.palette, scene.light, edit)
        colors = scene.colors(eye, palette, light, factors)
        opacities = scale_depth(scene.opacities, factors.opacity)
        return Gaussians(scene.means, scene.quats, scene.scales, opacities, colors)

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.safetensors`` per scene.

        Args:
            folder: empty.
            rate: words of each codebook; default: the option's.

        Raises:
            Refused: no such codebook size, or training is under way.
        """
        if self.stored is None:
            raise Refused("ivr-gs is quantised at the end of a fit only")
        return {one.coded.name: one.at(rate).write(folder, FORMAT) for one in self.stored}

    @classmethod
    def load(cls, folder: Path, device: str) -> IvrModel:
        read = read_folder(folder, METHOD, FORMAT, WIDTHS, partial(_checked, device=device))
        return cls([scene for _, scene in read], [Stored(coded, None, frozenset()) for coded, _ in read])

    @classmethod
    def join(cls, models: Sequence[IvrModel]) -> IvrModel:
        whole = all(model.stored is not None for model in models)
        stored = [one for model in models for one in model.stored or ()]
        return cls(
            [model.scene(name) for model in models for name in model.scenes], stored if whole else None
        )


def _checked(coded: QuantisedScene, device: str) -> ShadedGaussians:
    scene = ready(coded, device)
    numbers = [*scene.palette.tolist(), *(scene.light or ())]
    if len(scene.palette) != 3 or not all(math.isfinite(number) for number in numbers):
        raise ValueError("its palette or light is not three finite numbers")
    if not bool(torch.isfinite(scene.scales).all()):
        raise ValueError("a scale is not finite")
    if not bool((scene.quats.square().sum(1) > 0).all()):
        raise ValueError("a rotation is zero")
    return scene
