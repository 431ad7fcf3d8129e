"""Trained anchors of one or several scenes, rendered; and the folder that Scaffold-GS saves them in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self, get_args
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.anchors.decode import visible_anchors
from econgs_bench.econgs.anchors.direct import ColorDecoders, decode_colors
from econgs_bench.econgs.anchors.gaussians import Gaussians, apply_masks
from econgs_bench.econgs.codec.model import Attributes
from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.methods.gaussian_splatting.ply import Parts, properties, read_ply, write_ply
from econgs_bench.methods.interface import Decoding, Edit
from econgs_bench.methods.shared.coding import LARGEST
from econgs_bench.methods.shared.edits import opacity_factor, triple
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.model import SceneModel
from econgs_bench.methods.shared.sealed import read_tensors, write_tensors

FORMAT = "econgs-bench scaffold-gs 1"
Storage = Literal["read", "released"]
"""Columns of a file of anchors: those that a reader needs, or all that the released code writes."""
_UNUSED = {"opacity": -2.1972246, "rot_0": 1.0}
"""Column that nothing reads -> what the released code writes (logit of 0.1; no turn); others hold 0."""


@dataclass(frozen=True, eq=False)
class SceneAnchors:
    """The anchors of one scene, ready to be decoded.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        decoders: the scene's networks.
        positions: (N, 3).
        values: features (N, F), activated scalings (N, 6), offsets (N, K, 3).
        masks: (N, K) which offsets there are; None: all.
    """

    name: str
    background: RGB
    decoders: ColorDecoders
    positions: Tensor
    values: Attributes
    masks: Tensor | None = None

    def __len__(self) -> int:
        return len(self.positions)


class AnchorModel(SceneModel[SceneAnchors]):
    """Scenes of anchors, decoded for each view."""

    def decoding(self, scenes: Sequence[str]) -> Decoding:
        """For each frame; see :class:`.methods.interface.HasDecoders`."""
        return "per frame"

    def decoding_each_frame(self) -> Self:
        """This model."""
        return self

    def gaussians(self, scene: SceneAnchors, camera: Camera, edit: Edit) -> Gaussians:
        """The Gaussians of the anchors in view."""
        factor = opacity_factor(self.method, scene.name, edit)
        rows = visible_anchors(camera, scene.positions, scene.values.scalings).nonzero()[:, 0]
        whole = len(rows) == len(scene)  # as usual: nothing is copied
        positions, values, masks = scene.positions, scene.values, scene.masks
        if not whole:
            positions, values = positions[rows], values.of(rows)
            masks = None if masks is None else masks[rows]
        decoded = decode_colors(positions, *values, scene.decoders, camera.position, opacity=factor)
        if masks is not None:
            decoded = apply_masks(decoded, masks)
        return decoded if whole else replace(decoded, rows=rows)


def decoders_for(
    weights: Mapping[str, Tensor] | Mapping[str, NDArray[np.float32]],
    features: int,
    offsets: int,
    *,
    distance: bool,
) -> ColorDecoders:
    """Networks with room for stored weights, whose first layer gives the number of hidden units.

    Raises:
        KeyError, TypeError, ValueError: there are none, or a size is out of range.
    """
    hidden = len(weights["opacity.first_weight"])
    if not (1 <= features <= 1024 and 1 <= offsets <= 256 and 1 <= hidden <= 1024):
        raise ValueError(f"{features} features, {offsets} offsets and {hidden} hidden units")
    return ColorDecoders(features, offsets, hidden=hidden, distance=distance)


# --------------------------------------------------------------------------- Scaffold-GS's own folder


@dataclass(frozen=True, eq=False)
class StoredScene:
    """One scene as it is stored.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        decoders: the scene's networks.
        rows: (N, columns) float32, columns as in ``properties(parts_of(F, K))``.
        storage: columns of its file.
    """

    name: str
    background: RGB
    decoders: ColorDecoders
    rows: NDArray[np.float32]
    storage: Storage

    @classmethod
    def of(
        cls,
        name: str,
        background: RGB,
        decoders: ColorDecoders,
        positions: NDArray[np.float32],
        features: NDArray[np.float32],
        log_scalings: NDArray[np.float32],
        offsets: NDArray[np.float32],
        *,
        storage: Storage,
    ) -> StoredScene:
        """From the arrays of a trained scene."""
        by_axis = offsets.transpose(0, 2, 1).reshape(len(positions), 3 * decoders.offsets)
        columns = (positions, by_axis, features, log_scalings)
        return cls(name, background, decoders, np.concatenate(columns, 1, dtype=np.float32), storage)

    @property
    def parts(self) -> Parts:
        """Columns of its file."""
        return parts_of(self.decoders.features, self.decoders.offsets, self.storage)

    def table(self) -> NDArray[np.float32]:
        """(N, columns) float32 of its file."""
        places = properties(parts_of(self.decoders.features, self.decoders.offsets))
        names = properties(self.parts)
        table = np.empty((len(self.rows), len(names)), np.float32)
        for column, name in enumerate(names):
            table[:, column] = self.rows[:, places.index(name)] if name in places else _UNUSED.get(name, 0.0)
        return table

    def ready(self, device: str) -> SceneAnchors:
        """Its anchors on a device."""
        f, k, count = self.decoders.features, self.decoders.offsets, len(self.rows)
        table = torch.from_numpy(self.rows).to(device)
        positions, by_axis, features, log_scalings = table.split([3, 3 * k, f, SCALINGS], dim=1)
        return SceneAnchors(
            self.name,
            self.background,
            self.decoders,
            positions.contiguous(),
            Attributes(
                features.contiguous(),
                log_scalings.contiguous().exp(),
                by_axis.reshape(count, 3, k).transpose(1, 2).contiguous(),
            ),
        )


def parts_of(features: int, offsets: int, storage: Storage = "read") -> Parts:
    """Columns of the PLY; the released code writes eight that nothing reads."""
    released = {
        "positions": ("x", "y", "z"),
        "unused normals": ("nx", "ny", "nz"),
        "offsets": tuple(f"f_offset_{i}" for i in range(3 * offsets)),
        "features": tuple(f"f_anchor_feat_{i}" for i in range(features)),
        "unused opacity": ("opacity",),
        "scalings": tuple(f"scale_{i}" for i in range(SCALINGS)),
        "unused rotation": tuple(f"rot_{i}" for i in range(4)),
    }
    if storage == "released":
        return released
    return {part: names for part, names in released.items() if not part.startswith("unused")}


class ScaffoldModel(AnchorModel):
    """A model of Scaffold-GS: everything in float32, each scene with its own networks.

    Args:
        stored: at least one scene.
        device: where it renders.
    """

    method = "scaffold-gs"

    def __init__(self, stored: Sequence[StoredScene], device: str) -> None:
        self.stored, self.device = tuple(stored), device
        super().__init__(scene.ready(device) for scene in stored)

    def bytes_estimate(self) -> int:
        """Bytes of anchors and networks; headers and metadata add a few thousand."""
        networks = 4 * sum(one.numel() for scene in self.stored for one in scene.decoders.parameters())
        return networks + sum(4 * len(scene.rows) * len(properties(scene.parts)) for scene in self.stored)

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write ``<scene>.ply`` (anchors) and ``<scene>.safetensors`` (networks) per scene."""
        ledger: dict[str, dict[str, int]] = {}
        for scene in self.stored:
            stem = quote(scene.name, safe=" ")
            decoders = scene.decoders
            parts = write_ply(folder / f"{stem}.ply", scene.table(), scene.parts)
            about = {
                "format": FORMAT,
                "scene": scene.name,
                "background": list(scene.background),
                "features": decoders.features,
                "offsets": decoders.offsets,
                "distance": decoders.distance,
            }
            if scene.storage != "released":  # which files without it have
                about["storage"] = scene.storage
            weights = {name: one.cpu().contiguous() for name, one in decoders.state_dict().items()}
            sizes = write_tensors(folder / f"{stem}.safetensors", weights, about)
            metadata = sizes.pop("metadata")
            ledger[scene.name] = parts | {"decoders": sum(sizes.values()), "metadata": metadata}
        return ledger

    @classmethod
    def load(cls, folder: Path, device: str) -> ScaffoldModel:
        files = saved_files(folder, ".safetensors", cls.method)
        return cls([_load_scene(file, device) for file in files], device)

    @classmethod
    def join(cls, models: Sequence[ScaffoldModel]) -> ScaffoldModel:
        return cls([scene for model in models for scene in model.stored], models[0].device)


def _load_scene(file: Path, device: str) -> StoredScene:
    try:
        about, weights = read_tensors(file, FORMAT)
        features, offsets = int(about["features"]), int(about["offsets"])
        decoders = decoders_for(weights, features, offsets, distance=bool(about["distance"]))
        if not all(bool((one.abs() <= LARGEST).all()) for one in weights.values()):
            raise ValueError(f"a weight that is not finite, or of more than {LARGEST:g}")
        decoders.load_state_dict(weights)
        background = triple(about["background"])
        name, storage = str(about["scene"]), about.get("storage", "released")
        if storage not in get_args(Storage):
            raise ValueError(f"storage {storage!r}")
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = f"not the networks of a scaffold-gs scene ({error})"
        raise DataError(file, reason, "Save the model again") from error
    ply, parts = file.with_suffix(".ply"), parts_of(features, offsets)
    rows = read_ply(ply, parts)
    attributes = [place for place, name in enumerate(properties(parts)) if name.startswith("f_")]
    if np.abs(rows[:, attributes]).max(initial=0.0) > LARGEST:
        raise DataError(ply, f"holds an attribute of more than {LARGEST:g}", "Save the model again")
    decoders.requires_grad_(False)
    return StoredScene(name, background, decoders.to(device), rows, storage)
