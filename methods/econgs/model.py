"""A trained ECoNGS representation: groups of scenes that share decoders, rendered alone or composed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datasets.camera import Camera
from datasets.errors import DataError
from datasets.scene import RGB
from econgs.anchors.decode import decode, visible_anchors
from econgs.anchors.decoders import Decoders
from econgs.anchors.gaussians import Gaussians
from econgs.context.arrays import Precision
from econgs.context.container import Kind, overhead, read_container
from econgs.context.stream import GroupAttributes, SceneAttributes, encode_group
from methods.interface import Edit, Refused
from methods.shared.edits import Direction, shading_edit
from methods.shared.files import read_streams
from methods.shared.model import SceneModel

SUFFIX = ".econgs"


@dataclass(frozen=True, eq=False)
class SceneAnchors:
    """The anchors of one scene, ready to be decoded.

    Attributes:
        name: the scene's name.
        decoders: networks of its group.
        background: as recorded.
        light: unit vector to its directional light, or None for a headlight.
        positions: (N, 3).
        features: (N, F).
        scalings: (N, 6) activated.
        offsets: (N, K, 3).
        palette: (3,).
        embedding: (E,).
    """

    name: str
    decoders: Decoders
    background: RGB
    light: Direction | None
    positions: Tensor
    features: Tensor
    scalings: Tensor
    offsets: Tensor
    palette: Tensor
    embedding: Tensor

    def __len__(self) -> int:
        return len(self.positions)


class Group:
    """Scenes that were learned together, as their stream gives them back.

    Args:
        coded: the group; values are those that decoding its stream gives.
        device: where it renders.

    Raises:
        DataError: decoders or scene parameters are missing or have other shapes than the metadata say.
    """

    def __init__(self, coded: GroupAttributes, device: str, what: str = "group") -> None:
        self.coded = coded
        try:
            decoders = _decoders(coded).to(device)
            self.scenes = {
                scene.name: SceneAnchors(
                    scene.name,
                    decoders,
                    background=_triple(coded.metadata["scenes"][scene.name]["background"]),
                    light=_light(coded.metadata["scenes"][scene.name]["light"]),
                    **{
                        name: torch.from_numpy(np.ascontiguousarray(values)).to(device)
                        for name, values in {**_arrays(scene), **scene.parameters}.items()
                    },
                )
                for scene in coded.scenes
            }
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = f"its networks or scene parameters are not those of a model ({error})"
            raise DataError(what, reason, "Encode the model anew") from error


def _arrays(scene: SceneAttributes) -> dict[str, np.ndarray]:
    return {name: getattr(scene, name) for name in ("positions", "features", "scalings", "offsets")}


def _decoders(coded: GroupAttributes) -> Decoders:
    sizes = coded.metadata["decoders"]
    decoders = Decoders(
        int(sizes["features"]),
        int(sizes["offsets"]),
        int(sizes["embedding"]),
        hidden=int(sizes["hidden"]),
        view_direction=bool(sizes["view_direction"]),
        offset_color=sizes["offset_color"],
        storage=sizes["storage"],
    )
    decoders.load_state_dict({name: torch.from_numpy(np.array(v)) for name, v in coded.decoders.items()})
    return decoders.requires_grad_(False)


def decoders_metadata(decoders: Decoders, precision: Precision) -> dict[str, int | bool | str]:
    """Sizes and precision of the networks, from which a reader makes and writes them again."""
    names = ("features", "offsets", "embedding", "hidden", "view_direction", "offset_color", "storage")
    return {name: getattr(decoders, name) for name in names} | {"precision": precision}


def _triple(values: Sequence[float]) -> RGB:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _light(values: Sequence[float] | None) -> Direction | None:
    return None if values is None else _triple(values)


class EcongsModel(SceneModel[SceneAnchors]):
    """Groups of scenes, decoded for each view; shading is fused with decoding.

    Args:
        groups: at least one; no two scenes share a name.
    """

    method = "econgs"

    def __init__(self, groups: Sequence[Group]) -> None:
        self.groups = tuple(groups)
        super().__init__(scene for group in groups for scene in group.scenes.values())

    def bytes_estimate(self) -> int:
        """Bytes that :meth:`save` would write."""
        return sum(len(_encode(group)) for group in self.groups)

    def attributes(self, scene: str, count: int) -> Mapping[str, Tensor]:
        """Features, scalings and offsets of anchors; see :class:`methods.interface.HasAttributes`."""
        anchors = self.scene(scene)
        rows = torch.linspace(0, len(anchors.positions) - 1, min(count, len(anchors.positions))).long()
        names = ("features", "scalings", "offsets")
        return {name: getattr(anchors, name)[rows.to(anchors.positions.device)].flatten(1) for name in names}

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write the stream of each group, ``<place>.econgs``.

        Raises:
            Refused: ``rate`` is given; the rate is set by training.
        """
        if rate is not None:
            raise Refused("econgs has one size: set rate_weight and train")
        ledger: dict[str, dict[str, int]] = {}
        for place, group in enumerate(self.groups):
            data = _encode(group)
            (folder / f"{place}{SUFFIX}").write_bytes(data)
            for scene, parts in _ledger(data, tuple(group.scenes)).items():
                into = ledger.setdefault(scene, {})
                for part, count in parts.items():
                    into[part] = into.get(part, 0) + count
        return ledger

    def gaussians(self, scene: SceneAnchors, camera: Camera, edit: Edit) -> Gaussians:
        """The shaded Gaussians of the anchors in view."""
        palette, light, factors = shading_edit(scene.name, scene.palette, scene.light, edit)
        tensors = (scene.positions, scene.features, scene.scalings, scene.offsets)
        visible = visible_anchors(camera, scene.positions, scene.scalings)
        if not bool(visible.all()):
            rows = visible.nonzero()[:, 0]
            tensors = tuple(tensor.index_select(0, rows) for tensor in tensors)  # type: ignore[assignment]
        return decode(
            *tensors, scene.decoders, scene.embedding, palette, camera.position, light=light, factors=factors
        )

    @classmethod
    def load(cls, folder: Path, device: str) -> EcongsModel:
        """Read what :meth:`save` wrote.

        Raises:
            DataError: a stream is missing, damaged or of another kind.
        """
        return cls([Group(coded, device, file) for file, coded in read_streams(folder, SUFFIX, "econgs")])

    @classmethod
    def join(cls, models: Sequence[EcongsModel]) -> EcongsModel:
        """One model of the groups of several."""
        return cls([group for model in models for group in model.groups])


def _encode(group: Group) -> bytes:
    return encode_group(group.coded, weights=group.coded.metadata["decoders"]["precision"]).data


def _ledger(data: bytes, scenes: Sequence[str]) -> dict[str, dict[str, int]]:
    """Bytes of a stream by scene ("" for what all share) and part."""
    sections = read_container(data, "stream")
    ledger: dict[str, dict[str, int]] = {"": {"container": overhead(len(sections))}}
    for section in sections:
        scene = scenes[section.scene] if section.kind >= Kind.SCENE else ""
        parts = ledger.setdefault(scene, {})
        part = section.kind.name.lower()
        parts[part] = parts.get(part, 0) + len(section.payload)
    return ledger
