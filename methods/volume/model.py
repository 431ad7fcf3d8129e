"""Model of scenes on compressed volumes, drawn by the ray marcher of the ground truth."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from torch import Tensor

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.edits import edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth.model import Draw, Layer, Marcher
from econgs_bench.datasets.ground_truth.probe import find_backend
from econgs_bench.datasets.render_views import marcher_of
from econgs_bench.datasets.scene import RGB, BasicScene
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.shared.files import plain_name, saved_files
from econgs_bench.methods.shared.model import NamedScenes, seconds
from econgs_bench.methods.volume.codecs import Codec
from econgs_bench.methods.volume.stored import Samples, StoredVolume, read

_SUFFIX = ".json"


@dataclass(frozen=True, eq=False)
class VolumeScene:
    """A scene of a model.

    Attributes:
        scene: its definition, with the recorded background.
        stored: its volume; scenes of one variable share it.
        samples: what the volume was made from; None in a model that was loaded.
    """

    scene: BasicScene
    stored: StoredVolume
    samples: Samples | None = None

    @property
    def name(self) -> str:
        return self.scene.name

    @property
    def background(self) -> RGB:
        return self.scene.background

    def __len__(self) -> int:
        return int(self.stored.volume.values.size)


class VolumeModel(NamedScenes[VolumeScene]):
    """A :class:`.methods.interface.Model` whose primitives are voxels.

    Args:
        scenes: at least one, with distinct names.
        codec: compressor of the volumes.
        device: "cpu" or "cuda", of the marcher and of the pictures.

    Raises:
        Refused: two scenes have the same name.
    """

    def __init__(self, scenes: Iterable[VolumeScene], codec: Codec, device: str) -> None:
        super().__init__(scenes)
        self.codec, self.device = codec, device
        self._marchers: dict[tuple[int, ...], Marcher] = {}
        self._last: tuple[Any, Draw] | None = None

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write every file; see :class:`.methods.interface.Model`.

        Args:
            folder: where to.
            rate: error bound; default: that of the model.

        Raises:
            Refused: the model was loaded, so that it knows no other size.
        """
        scenes = self._at(rate)
        volumes = {scene.stored.file: scene.stored for scene in scenes}
        shared: dict[str, int] = {}
        for name, stored in volumes.items():
            (folder / name).write_bytes(stored.data)
            for part, count in stored.parts.items():
                shared[part] = shared.get(part, 0) + count
        ledger = {"": shared}
        for scene in scenes:
            about = {
                "volume": scene.stored.file,
                "scene": definitions().dump_python(scene.scene, mode="json"),
            }
            text = json.dumps(about, separators=(",", ":"))
            data = json.dumps({**about, "crc32": zlib.crc32(text.encode())}, separators=(",", ":")).encode()
            (folder / f"{quote(scene.name, safe=' ')}{_SUFFIX}").write_bytes(data)
            ledger[scene.name] = {"scene": len(data)}
        return ledger

    def _at(self, bound: float | None) -> list[VolumeScene]:
        """The scenes with their volumes at another error bound."""
        every = list(self._scenes.values())
        if bound is None or all(scene.stored.bound == bound for scene in every):
            return every
        again: dict[int, StoredVolume] = {}
        for scene in every:
            if scene.samples is None:
                raise Refused(
                    f"the volume of scene {scene.name!r} was stored with an error of up to "
                    f"{scene.stored.bound:g}: it has no other size"
                )
            if id(scene.samples) not in again:
                again[id(scene.samples)] = scene.samples.stored(self.codec, bound)
        return [replace(scene, stored=again[id(scene.samples)]) for scene in every]

    @classmethod
    def load(cls, folder: Path, codec: Codec, device: str) -> VolumeModel:
        """Read what :meth:`save` wrote.

        Raises:
            DataError: a file is missing, damaged or of another kind.
            Refused: the compressor is not installed.
        """
        volumes: dict[str, StoredVolume] = {}
        scenes = []
        for file in saved_files(folder, _SUFFIX, codec.name):
            try:
                about = json_of(file.read_bytes())
                check = about.pop("crc32")
                if zlib.crc32(json.dumps(about, separators=(",", ":")).encode()) != check:
                    raise ValueError("its checksum differs")
                scene = definitions().validate_python(about["scene"])
                name = plain_name(about["volume"])
                if scene.transfer is None and not scene.isosurfaces:
                    raise ValueError("it shows nothing of the volume")
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                raise DataError(
                    file, f"not a scene of {codec.name} ({error})", "Save the model again"
                ) from error
            if name not in volumes:
                volumes[name] = _volume(folder / name, codec)
            scenes.append(VolumeScene(scene, volumes[name]))
        return cls(scenes, codec, device)

    @classmethod
    def join(cls, models: Sequence[VolumeModel]) -> VolumeModel:
        """One model of the scenes of several, of at least one."""
        scenes = [model.scene(name) for model in models for name in model.scenes]
        # One variable in several groups is one volume.
        same: dict[str, StoredVolume] = {}
        for scene in scenes:
            same.setdefault(scene.stored.file, scene.stored)
        shared = (replace(scene, stored=same[scene.stored.file]) for scene in scenes)
        return cls(shared, models[0].codec, models[0].device)

    def picture(
        self, scenes: Sequence[VolumeScene], camera: Camera, edits: Mapping[str, Edit]
    ) -> tuple[Tensor, Tensor]:
        """All volumes of the scenes, marched at once."""
        picture = torch.from_numpy(self._draw(scenes, edits)((camera,))[0]).to(self.device)
        return picture[..., :3], picture[..., 3].clamp(0.0, 1.0)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame of scenes (default: all) by part.

        The marcher classifies, shades and composites in one kernel. Volumes are decompressed when the model
        is loaded, not in a frame.
        """
        subset = self.chosen(scenes)
        start = seconds()
        self._draw(subset, {})((camera,))
        return {"decode": 0.0, "shade": 0.0, "rasterise": seconds() - start}

    def _draw(self, subset: Sequence[VolumeScene], edits: Mapping[str, Edit]) -> Draw:
        """What draws edited scenes together; that of the last call is kept."""
        key = ([scene.name for scene in subset], {name: e for name, e in edits.items() if e != Edit()})
        if self._last is None or self._last[0] != key:
            try:
                shown = [edited(scene.scene, edits.get(scene.name, Edit())) for scene in subset]
                layers = [
                    Layer.of(scene, one.stored.volume) for scene, one in zip(shown, subset, strict=True)
                ]
                self._last = key, self._marcher(layers).prepare(layers)
            except DataError as error:
                raise Refused(str(error)) from error
        return self._last[1]

    def _marcher(self, layers: Sequence[Layer]) -> Marcher:
        """The marcher on the volumes of layers."""
        volumes = list({id(layer.volume): layer.volume for layer in layers}.values())
        key = tuple(sorted(id(volume) for volume in volumes))
        if key not in self._marchers:
            self._marchers[key] = marcher_of(volumes, find_backend(self.device.startswith("cuda")))
        return self._marchers[key]


def _volume(file: Path, codec: Codec) -> StoredVolume:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise DataError(file, f"cannot be read ({error})", "Save the model again") from error
    return read(data, codec, str(file))


@cache
def definitions() -> Any:
    """Converts scenes to JSON values and back."""
    from pydantic import TypeAdapter

    return TypeAdapter(BasicScene)
