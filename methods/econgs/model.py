"""A trained ECoNGS representation: groups of scenes that share decoders, rendered alone or composed."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.anchors.decode import decode, decode_unshaded, visible_anchors
from econgs_bench.econgs.anchors.decoders import Decoders
from econgs_bench.econgs.anchors.gaussians import Gaussians, UnshadedGaussians
from econgs_bench.econgs.codec.arrays import Precision
from econgs_bench.econgs.codec.container import Kind, overhead, read_container
from econgs_bench.econgs.codec.group import GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.model import Attributes
from econgs_bench.econgs.codec.stream import encode_group
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.methods.interface import Decoding, Edit
from econgs_bench.methods.shared.coding import placed, placed_anchors, stored_networks
from econgs_bench.methods.shared.edits import Direction, shading_edit, triple
from econgs_bench.methods.shared.files import read_streams
from econgs_bench.methods.shared.model import SceneModel

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
        values: features (N, F), activated scalings (N, 6), offsets (N, K, 3).
        palette: (3,).
        embedding: (E,).
    """

    name: str
    decoders: Decoders
    background: RGB
    light: Direction | None
    positions: Tensor
    values: Attributes
    palette: Tensor
    embedding: Tensor

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def unshaded(self) -> UnshadedGaussians:
        """Gaussians for every view, where decoders do not see the direction."""
        return decode_unshaded(self.positions, *self.values, self.decoders, self.embedding)


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
            decoders, about = _decoders(coded, device), coded.metadata["scenes"]
            self.scenes = {
                scene.name: _ready(scene, about[scene.name], decoders, device) for scene in coded.scenes
            }
        except (UnknownName, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = f"its networks or scene parameters are not those of a model ({error})"
            raise DataError(what, reason, "Encode the model anew") from error


def _ready(scene: SceneAttributes, about: Mapping[str, Any], decoders: Decoders, device: str) -> SceneAnchors:
    return SceneAnchors(
        scene.name,
        decoders,
        triple(about["background"]),
        None if about["light"] is None else triple(about["light"]),
        *placed_anchors(scene, device),
        **{name: placed(values, device) for name, values in scene.parameters.items()},  # type: ignore[arg-type]
    )


def _decoders(coded: GroupAttributes, device: str) -> Decoders:
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
    if not any(map(len, coded.scenes)):
        return decoders.to(device)  # nothing to decode
    return stored_networks(decoders, coded, device)


def decoders_metadata(decoders: Decoders, precision: Precision) -> dict[str, int | bool | str]:
    """Sizes and precision of the networks, from which a reader makes and writes them again."""
    names = ("features", "offsets", "embedding", "hidden", "view_direction", "offset_color", "storage")
    return {name: getattr(decoders, name) for name in names} | {"precision": precision}


class EcongsModel(SceneModel[SceneAnchors]):
    """Groups of scenes, decoded once and shaded for each view.

    Decoders that see the direction decode for each view, shading included.

    Args:
        groups: at least one; no two scenes share a name.

    Attributes:
        each_frame: whether all decoders run for each view.
    """

    method = "econgs"
    each_frame = False

    def __init__(self, groups: Sequence[Group]) -> None:
        self.groups = tuple(groups)
        super().__init__(scene for group in groups for scene in group.scenes.values())
        if not any(scene.decoders.view_direction for scene in self._scenes.values()):
            self.preparation = "shade"

    def decoding(self, scenes: Sequence[str]) -> Decoding:
        """Once, unless decoders see the direction; see :class:`.methods.interface.HasDecoders`."""
        return "per frame" if any(map(self._each_frame, self.chosen(scenes))) else "once"

    def decoding_each_frame(self) -> EcongsModel:
        """This model, with decoders that run as if all of them saw the direction."""
        model = copy(self)
        model.each_frame, model.preparation = True, "decode"
        return model

    def _each_frame(self, scene: SceneAnchors) -> bool:
        return self.each_frame or scene.decoders.view_direction

    def bytes_estimate(self) -> int:
        """Bytes that :meth:`save` would write."""
        return sum(len(_encode(group)) for group in self.groups)

    def attributes(self, scene: str, count: int) -> Mapping[str, Tensor]:
        """Features, scalings and offsets of anchors; see :class:`.methods.interface.HasAttributes`."""
        anchors = self.scene(scene)
        rows = torch.linspace(0, len(anchors) - 1, min(count, len(anchors))).long()
        values = anchors.values.of(rows.to(anchors.positions.device))
        return {name: one.flatten(1) for name, one in values._asdict().items()}

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write the stream of each group, ``<place>.econgs``; ``rate_weight`` sets its size in training."""
        ledger: defaultdict[str, Counter[str]] = defaultdict(Counter)  # "" for what a group shares
        for place, group in enumerate(self.groups):
            data, names = _encode(group), tuple(group.scenes)
            (folder / f"{place}{SUFFIX}").write_bytes(data)
            sections = read_container(data, "stream")
            ledger[""]["container"] += overhead(len(sections))
            for section in sections:
                scene = names[section.scene] if section.kind >= Kind.SCENE else ""
                ledger[scene][section.kind.name.lower()] += len(section.payload)
        return {scene: dict(parts) for scene, parts in ledger.items()}

    def gaussians(self, scene: SceneAnchors, camera: Camera, edit: Edit) -> Gaussians:
        """The shaded Gaussians of the anchors in view."""
        palette, light, factors = shading_edit(scene.name, scene.palette, scene.light, edit)
        shown = visible_anchors(camera, scene.positions, scene.values.scalings)
        decoders, embedding = scene.decoders, scene.embedding
        if self._each_frame(scene):
            positions, values = scene.positions, scene.values
            rows = shown.nonzero()[:, 0]
            if len(rows) < len(positions):
                positions, values = positions.index_select(0, rows), values.of(rows)
            eye = camera.position
            decoded = decode(
                positions, *values, decoders, embedding, palette, eye, light=light, factors=factors
            )
            return decoded if len(rows) == len(scene) else replace(decoded, rows=rows)
        ready = scene.unshaded
        if not bool(shown.all()):
            ready = ready.of(shown[ready.slots // decoders.offsets].nonzero()[:, 0])
        toward = None if light is None else ready.means.new_tensor(light)
        colors = ready.colors(palette, ready.means.new_tensor(camera.position), toward, factors)
        opacities = scale_depth(ready.opacities, factors.opacity)
        return Gaussians(ready.means, ready.quats, ready.scales, opacities, colors, ready.slots)

    @classmethod
    def load(cls, folder: Path, device: str) -> EcongsModel:
        model = cls([Group(coded, device, file) for file, coded in read_streams(folder, SUFFIX, "econgs")])
        for scene in model._scenes.values():
            if not scene.decoders.view_direction:
                _ = scene.unshaded  # decoding once is a part of loading, not of the first frame
        return model

    @classmethod
    def join(cls, models: Sequence[EcongsModel]) -> EcongsModel:
        return cls([group for model in models for group in model.groups])


def _encode(group: Group) -> bytes:
    return encode_group(group.coded, weights=group.coded.metadata["decoders"]["precision"]).data
