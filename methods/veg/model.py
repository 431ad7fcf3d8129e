"""A trained VEG representation: Gaussians that carry a scalar, seen through transfer functions, and saved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol
from urllib.parse import quote

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.edits import edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB, WHITE, BasicScene
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.codebooks import quantise_scalars
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.model import SceneModel
from econgs_bench.methods.shared.quantised_scene import Column, QuantisedScene, half_exact, read_folder
from econgs_bench.methods.shared.sealed import read_facts, write_facts
from econgs_bench.methods.veg.appearance import Appearance, scene_as_json, scene_from_json

FORMAT = "econgs-bench veg 1"
METHOD = "veg"
SCENE_SUFFIX = ".json"
WIDTHS = {
    "opacity": 1,
    "scale": 3,
    "rotation real": 1,
    "rotation imaginary": 3,
    "normal": 3,
    "scalar": 1,
    "ambient": 1,
    "diffuse": 1,
    "specular": 1,
    "shininess": 1,
}
"""Columns of the file -> numbers per Gaussian: values before their activation, which is applied once."""
HALVES = ("specular", "shininess")
"""Columns in half precision, as positions are; the others have codebooks."""
MOST = 2.0
"""Greatest factor on the specular coefficient and the power of the highlight."""
_SEED = 0  # scalar codebooks start from quantiles: no choice depends on it
Law = Literal["depth", "product"]


@dataclass(frozen=True, eq=False)
class ScalarGaussians:
    """Gaussians that carry a scalar, ready to be looked up.

    Attributes:
        law: how opacity follows from the look-up: "depth" or "product".
        means: (N, 3).
        scales: (N, 3) standard deviations.
        quats: (N, 4), w x y z.
        normals: (N, 3) of any length.
        scalars: (N,) in [0, 1].
        opacities: (N,) in [0, 1]: shares of the volume's density (depth), or opacities (product).
        factors: (N, 4) on k_a, k_d, k_s and β of a scene's light; None: nothing is shaded yet.
    """

    law: Law
    means: Tensor
    scales: Tensor
    quats: Tensor
    normals: Tensor
    scalars: Tensor
    opacities: Tensor
    factors: Tensor | None

    def __len__(self) -> int:
        return len(self.means)

    def of(self, rows: Tensor) -> ScalarGaussians:
        """Some of the Gaussians, by their indices."""
        if len(rows) == len(self):
            return self
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "law"}
        taken = {name: None if one is None else one.index_select(0, rows) for name, one in arrays.items()}
        return ScalarGaussians(self.law, **taken)  # type: ignore[arg-type]

    def seen(self, looks: Sequence[Appearance], eye: Tensor) -> tuple[Tensor, Tensor]:
        """Colors (N, 3) and opacities (N,) through one transfer function or several at once; differentiable.

        Extinctions add, and colors are means weighted by them, as in the ground truth of a composition.

        Args:
            looks: at least one; each Gaussian has extinction in one of them.
            eye: (3,) camera centre.
        """
        weights, colors = [], []
        for look in looks:
            looked = look.look_up(self.scalars)
            color = looked[:, :3]
            if self.factors is not None:
                color = look.shade(self.means, self.normals, color, self.factors, eye)
            colors.append(color)
            weights.append(looked[:, 3])
        if len(looks) == 1:
            return colors[0], self.opaque(looks, weights)
        total = torch.stack(weights).sum(0)
        shares = [(weight / total)[:, None] for weight in weights]
        mixed = torch.stack([share * color for share, color in zip(shares, colors, strict=True)]).sum(0)
        return mixed, self.opaque(looks, weights)

    def opaque(self, looks: Sequence[Appearance], extinctions: Sequence[Tensor]) -> Tensor:
        """(N,) opacities of Gaussians that have these extinctions in those looks.

        Depth: 1 - exp(-share · extinction · length), the length of a mean ray through the Gaussian.
        Product: opacity · (1 - exp(-extinction · reference length)).
        """
        if self.law == "depth":
            depth = sum(extinctions[1:], extinctions[0]) * self.opacities * mean_lengths(self.scales)
            return -torch.expm1(-depth)
        depths = [one * look.reference for one, look in zip(extinctions, looks, strict=True)]
        return self.opacities * -torch.expm1(-sum(depths[1:], depths[0]))


def mean_lengths(scales: Tensor) -> Tensor:
    """(N,) length on which a ray through a Gaussian would meet its mass at its peak density.

    A Gaussian of peak 1 has the mass (2π)^1.5 σ₁σ₂σ₃ and, seen along an axis, the area 2πσσ'; the length is
    the mass over the root of the mean square of the areas, the mean that the rasteriser's ``ray_power`` has.
    """
    return math.sqrt(2.0 * math.pi) * scales.square().reciprocal().mean(dim=1).rsqrt()


def visible_rows(scalars: Tensor, looks: Sequence[Appearance]) -> Tensor:
    """Indices of the scalars that have extinction in any of the looks."""
    total = looks[0].extinctions(scalars)
    for look in looks[1:]:
        total = total + look.extinctions(scalars)
    return total.nonzero()[:, 0]


def activated(raw: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Fields of :class:`ScalarGaussians` from columns; differentiable."""
    quats = torch.cat([raw["rotation real"], raw["rotation imaginary"]], dim=1)
    return {
        "scales": raw["scale"].exp(),
        "quats": torch.nn.functional.normalize(quats, dim=1),
        "normals": raw["normal"],
        "scalars": raw["scalar"][:, 0].sigmoid(),
        "opacities": raw["opacity"][:, 0].sigmoid(),
        "factors": torch.cat(
            [
                raw["ambient"],
                raw["diffuse"],
                MOST * raw["specular"].sigmoid(),
                MOST * raw["shininess"].sigmoid(),
            ],
            dim=1,
        ),
    }


# --------------------------------------------------------------------------- scenes


@dataclass(frozen=True, eq=False)
class Field:
    """The Gaussians of one variable, which all of its scenes share.

    Attributes:
        gaussians: ready to be looked up.
        table_size: entries of the look-ups.
    """

    gaussians: ScalarGaussians
    table_size: int

    def look(self, scene: BasicScene) -> Appearance:
        """How a scene is looked up."""
        return Appearance.of(scene, self.table_size, self.gaussians.means.device)


@dataclass(frozen=True, eq=False)
class VegScene:
    """One transfer function on the Gaussians of its variable; its length is the number that it shows.

    Attributes:
        definition: transfer function, light and background; lengths in the units of the Gaussians.
        field: the Gaussians.
    """

    definition: BasicScene
    field: Field

    @property
    def name(self) -> str:
        return self.definition.name

    @property
    def background(self) -> RGB:
        return self.definition.background

    @cached_property
    def look(self) -> Appearance:
        """How it is looked up."""
        return self.field.look(self.definition)

    @cached_property
    def rows(self) -> Tensor:
        """Indices of the Gaussians that it shows."""
        return visible_rows(self.field.gaussians.scalars, [self.look])

    def __len__(self) -> int:
        return len(self.rows)


# --------------------------------------------------------------------------- files


@dataclass(frozen=True, eq=False)
class Stored:
    """Gaussians as they are saved: quantised already, and what they were before, for saving at other sizes.

    Attributes:
        coded: at the default codebook size.
        raw: column -> (N, width) values that were learned; None where a file was read, which has one size.
    """

    coded: QuantisedScene
    raw: Mapping[str, Tensor] | None

    @classmethod
    def of(cls, law: Law, table_size: int, positions: Tensor, raw: Mapping[str, Tensor], size: int) -> Stored:
        """Codebooks of what was learned."""
        about = {"law": law, "table": table_size}
        bare = QuantisedScene("0", WHITE, about, half_exact(positions), {}, "fixed")
        return cls(_coded(bare, raw, size), raw)

    def at(self, size: float | None) -> QuantisedScene:
        """The Gaussians with codebooks of another size; the default's where it is None."""
        if size is None:
            return self.coded
        if self.raw is None:
            raise Refused("veg saves a model that was loaded at the codebook size that it has")
        if size != int(size) or not 1 <= size <= 65536:
            raise Refused(f"veg has no codebooks of {size:g} words: 1 to 65536")
        return _coded(self.coded, self.raw, int(size))

    def field(self, device: str) -> Field:
        """The Gaussians, ready to be looked up."""
        law, table_size = self.coded.about["law"], self.coded.about["table"]
        if law not in ("depth", "product") or not isinstance(table_size, int) or table_size < 2:
            raise ValueError(f"opacity law {law!r}, look-up of {table_size!r} entries")
        raw = {name: self.coded.column(name, width).to(device) for name, width in WIDTHS.items()}
        means = self.coded.positions.to(device)
        gaussians = ScalarGaussians(law, means=means, **activated(raw))  # type: ignore[arg-type]
        if not bool(torch.isfinite(gaussians.scales).all()):
            raise ValueError("a scale is not finite")
        if not bool((gaussians.quats.square().sum(1) > 0).all()):
            raise ValueError("a rotation is zero")
        return Field(gaussians, table_size)


def _coded(bare: QuantisedScene, raw: Mapping[str, Tensor], size: int) -> QuantisedScene:
    columns: dict[str, Column] = {}
    for name in WIDTHS:
        values = raw[name].detach().cpu()
        columns[name] = half_exact(values) if name in HALVES else (quantise_scalars(values, size, _SEED),)
    return replace(bare, columns=columns)


@dataclass(frozen=True, eq=False)
class Group:
    """Scenes of one variable.

    Attributes:
        scenes: definitions.
        field: their Gaussians, ready.
        stored: the Gaussians as they are saved; None while training is under way.
    """

    scenes: tuple[BasicScene, ...]
    field: Field
    stored: Stored | None


class VegModel(SceneModel[VegScene]):
    """Groups of scenes; those of one group are transfer functions on the same Gaussians.

    Args:
        groups: at least one; no two scenes share a name.
    """

    method = METHOD
    preparation = "shade"

    def __init__(self, groups: Sequence[Group]) -> None:
        self.groups = tuple(groups)
        super().__init__(VegScene(scene, group.field) for group in groups for scene in group.scenes)

    def gaussians(self, scene: VegScene, camera: Camera, edit: Edit) -> Gaussians:
        """The Gaussians that one scene shows."""
        return self.together([scene], camera, {scene.name: edit})[0]

    def together(
        self, scenes: Sequence[VegScene], camera: Camera, edits: Mapping[str, Edit]
    ) -> list[Gaussians]:
        """The Gaussians of each variable, seen through the transfer functions of all scenes that show it."""
        by_field: dict[Field, list[VegScene]] = {}
        for scene in scenes:
            by_field.setdefault(scene.field, []).append(scene)
        return [self._shown(field.gaussians, members, camera, edits) for field, members in by_field.items()]

    def _shown(
        self,
        gaussians: ScalarGaussians,
        scenes: Sequence[VegScene],
        camera: Camera,
        edits: Mapping[str, Edit],
    ) -> Gaussians:
        looks = [self._look(scene, edits.get(scene.name, Edit())) for scene in scenes]
        (first, *others) = scenes
        alone = not others and looks[0] is first.look
        rows = first.rows if alone else visible_rows(gaussians.scalars, looks)
        part = gaussians.of(rows)
        colors, opacities = part.seen(looks, part.means.new_tensor(camera.position))
        return Gaussians(part.means, part.quats, part.scales, opacities, colors, rows)

    def _look(self, scene: VegScene, edit: Edit) -> Appearance:
        if edit == Edit():
            return scene.look
        if edit.transfer is not None:  # lengths in the units of the Gaussians
            length = edit.transfer.reference_length / self.rendering.units
            edit = replace(edit, transfer=replace(edit.transfer, reference_length=length))
        try:
            changed = edited(scene.definition, edit)
        except DataError as error:
            raise Refused(str(error)) from error
        return scene.field.look(changed)

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write ``<place>.safetensors`` per variable and ``<scene>.json`` per scene.

        Args:
            folder: empty.
            rate: words of each codebook; default: the option's.

        Raises:
            Refused: no such codebook size, or training is under way.
        """
        ledger: dict[str, dict[str, int]] = {"": {}}
        for place, group in enumerate(self.groups):
            if group.stored is None:
                raise Refused("veg is quantised at the end of a fit only")
            parts = replace(group.stored.at(rate), name=str(place)).write(folder, FORMAT)
            ledger[""] = {name: ledger[""].get(name, 0) + size for name, size in parts.items()}
            for scene in group.scenes:
                about = {"format": FORMAT, "gaussians": place, "scene": scene_as_json(scene)}
                size = write_facts(folder / f"{quote(scene.name, safe=' ')}{SCENE_SUFFIX}", about)
                ledger[scene.name] = {"transfer function": size}
        return ledger

    @classmethod
    def load(cls, folder: Path, device: str) -> VegModel:
        read = read_folder(folder, METHOD, FORMAT, WIDTHS, lambda coded: Stored(coded, None).field(device))
        scenes: dict[str, list[BasicScene]] = {coded.name: [] for coded, _ in read}
        for file in saved_files(folder, SCENE_SUFFIX, METHOD):
            try:
                about = read_facts(file, FORMAT)
                scenes[str(about["gaussians"])].append(scene_from_json(about["scene"]))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise DataError(file, f"not a scene of veg ({error})", "Save the model again") from error
        return cls(
            [
                Group(tuple(scenes[coded.name]), field, Stored(coded, None))
                for coded, field in read
                if scenes[coded.name]
            ]
        )

    @classmethod
    def join(cls, models: Sequence[VegModel]) -> VegModel:
        return cls([group for model in models for group in model.groups])


class HasColumns(Protocol):
    """Parameters of a fit by name, as its optimiser holds them."""

    def __getitem__(self, name: str) -> Tensor: ...


def columns(parameters: HasColumns) -> dict[str, Tensor]:
    """Parameters of a fit as columns of the model; differentiable."""
    unit = torch.nn.functional.normalize(parameters["quats"], dim=1)
    plain = ("ambient", "diffuse", "specular", "shininess")
    return {
        "opacity": parameters["opacities"][:, None],
        "scale": parameters["log_scales"],
        "rotation real": unit[:, :1],
        "rotation imaginary": unit[:, 1:],
        "normal": parameters["normals"],
        "scalar": parameters["scalars"][:, None],
        **{name: parameters[name] for name in plain},
    }
