"""A trained HAC representation and its self-contained stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, get_args
from urllib.parse import quote

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.codec.arrays import Precision
from econgs_bench.econgs.codec.group import GroupAttributes
from econgs_bench.econgs.codec.stream import Encoded, encode_group
from econgs_bench.methods.scaffold_gs.model import AnchorModel, SceneAnchors, decoders_for
from econgs_bench.methods.shared.coding import placed, placed_anchors, stored_networks
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.files import read_streams


class HacModel(AnchorModel):
    """Scenes as their streams give them back.

    Args:
        groups: of one scene each; values are those that decoding their streams gives.
        device: where it renders.
        files: theirs, for messages; none where they come from training.

    Raises:
        DataError: a group is not one of this method.
    """

    method = "hac"
    suffix: ClassVar[str] = ".hac"

    def __init__(self, groups: Sequence[GroupAttributes], device: str, files: Sequence[str] = ()) -> None:
        self.groups, self.device = tuple(groups), device
        named = zip(self.groups, files or ["group"] * len(self.groups), strict=True)
        super().__init__(_ready(group, device, file, self.method) for group, file in named)

    @classmethod
    def metadata(cls, background: RGB, precision: Precision) -> dict[str, Any]:
        """Metadata of a stream."""
        about = {"method": cls.method, "background": list(background)}
        return about if precision == "float32" else about | {"precision": precision}

    def bytes_estimate(self) -> int:
        """Bytes that :meth:`save` would write."""
        return sum(len(_encoded(group).data) for group in self.groups)

    def write(self, folder: Path) -> Mapping[str, Mapping[str, int]]:
        """Write the stream of each scene, ``<scene>.hac``; ``rate_weight`` sets its size in training."""
        ledger = {}
        for group in self.groups:
            name = group.scenes[0].name
            encoded = _encoded(group)
            (folder / f"{quote(name, safe=' ')}{self.suffix}").write_bytes(encoded.data)
            ledger[name] = dict(encoded.ledger)
        return ledger

    @classmethod
    def load(cls, folder: Path, device: str) -> HacModel:
        files, groups = zip(*read_streams(folder, cls.suffix, cls.method), strict=True)
        return cls(groups, device, files)

    @classmethod
    def join(cls, models: Sequence[HacModel]) -> HacModel:
        return cls([group for model in models for group in model.groups], models[0].device)


def _encoded(group: GroupAttributes) -> Encoded:
    """The stream of a scene; without a precision in its metadata, networks are in float32."""
    return encode_group(group, weights=group.metadata.get("precision", "float32"))


def _ready(group: GroupAttributes, device: str, what: str, method: str) -> SceneAnchors:
    """The scene of a group on a device."""
    try:
        (scene,) = group.scenes
        if group.metadata["method"] != method or scene.masks is None:
            raise ValueError("it is of another method")
        if group.metadata.get("precision", "float32") not in get_args(Precision):
            raise ValueError("its networks have an unknown precision")
        background = triple(group.metadata["background"])
        sizes = scene.features.shape[1], scene.offsets.shape[1]
        decoders = decoders_for(group.decoders, *sizes, distance=True)
        stored_networks(decoders, group, device)
        anchors = placed_anchors(scene, device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = f"it is not the model of a {method} scene ({error})"
        raise DataError(what, reason, "Encode the model anew") from error
    masks = placed(scene.masks, device)
    return SceneAnchors(scene.name, background, decoders, *anchors, masks)
