"""A trained model of 3DGS that is saved by a codec, and shown as its files hold it."""

from __future__ import annotations

import json
import tempfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.coded.spec import CODECS, DEFAULT
from econgs_bench.methods.formats.gaussians import scene_of
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians, SplatModel
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.decoders import own_streams
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.files import saved_files

FORMAT = "econgs-bench 3dgs-coded 1"
_ABOUT = ".codec"
"""Suffix of the file beside a scene's Gaussians: what formats of splats have no place for, and a checksum."""


@dataclass(frozen=True)
class SavedScene:
    """The files of a scene.

    Attributes:
        codec: its number in :data:`.methods.coded.spec.CODECS`.
        gaussians, about: bytes of both files.
    """

    codec: int
    gaussians: bytes
    about: bytes


class CodedModel(SplatModel):
    """Scenes as a codec keeps them.

    Args:
        rendered: Gaussians of each scene after coding and decoding.
        sources: what is saved of each: Gaussians that any codec codes, or the files that it was loaded from.
    """

    method = "3dgs-coded"

    def __init__(
        self, rendered: Iterable[SceneGaussians], sources: Iterable[SceneGaussians | SavedScene]
    ) -> None:
        super().__init__(rendered)
        self.sources = tuple(sources)

    @classmethod
    def of(cls, trained: Sequence[SceneGaussians]) -> CodedModel:
        """A model of trained scenes, shown as the default codec keeps them."""
        return cls([_through(DEFAULT, scene) for scene in trained], trained)

    def write_size(self, folder: Path, rate: float | None) -> Mapping[str, Mapping[str, int]]:
        """Write a file of Gaussians and a short one beside it per scene.

        Args:
            folder: where to.
            rate: number of a codec in :data:`.methods.coded.spec.CODECS`.

        Raises:
            Refused: there is no such codec, or a package that it needs; or the model was loaded from files of
                another one.
        """
        if rate is not None and rate not in CODECS:
            names = ", ".join(f"{number} ({codec.name})" for number, codec in CODECS.items())
            raise Refused(f"3dgs-coded has no codec {rate:g}, only {names}")
        number = None if rate is None else int(rate)
        return {
            name: _write(folder, number, source, name)
            for name, source in zip(self.scenes, self.sources, strict=True)
        }

    @classmethod
    def load(cls, folder: Path, device: str) -> CodedModel:
        read = [_read(file, device) for file in saved_files(folder, _ABOUT, "3dgs-coded")]
        return cls((scene for scene, _ in read), (saved for _, saved in read))

    @classmethod
    def join(cls, models: Sequence[CodedModel]) -> CodedModel:
        rendered = [model.scene(name) for model in models for name in model.scenes]
        return cls(rendered, [source for model in models for source in model.sources])


def _format(number: int) -> Any:
    return import_module(f"econgs_bench.methods.formats.{CODECS[number].format}")


def _write(
    folder: Path, number: int | None, source: SceneGaussians | SavedScene, name: str
) -> dict[str, int]:
    """Write the files of a scene; bytes by part, which begin with the codec's name."""
    stem = quote(name, safe=" ")
    if isinstance(source, SavedScene):
        codec = CODECS[source.codec]
        if number not in (None, source.codec):
            raise Refused(f"scene {name!r} was loaded from files of the codec {codec.name}: it has no others")
        (folder / f"{stem}{_ABOUT}").write_bytes(source.about)
        (folder / f"{stem}{_format(source.codec).SUFFIX}").write_bytes(source.gaussians)
        return {f"{codec.name}: file": len(source.gaussians), "metadata": len(source.about)}
    number = DEFAULT if number is None else number
    module, codec = _format(number), CODECS[number]
    parts = module.write(folder / f"{stem}{module.SUFFIX}", source, **dict(codec.settings))
    about = {
        "format": FORMAT, "scene": name, "background": list(source.background),
        "sh_degree": source.sh_degree, "codec": codec.name,
    }  # fmt: skip
    text = json.dumps(about).encode()
    size = (folder / f"{stem}{_ABOUT}").write_bytes(text + b"\n" + str(zlib.crc32(text)).encode())
    return {f"{codec.name}: {part}": count for part, count in parts.items()} | {"metadata": size}


def _read(file: Path, device: str) -> tuple[SceneGaussians, SavedScene]:
    try:
        data = file.read_bytes()
        text, _, check = data.rpartition(b"\n")
        if check != str(zlib.crc32(text)).encode():
            raise ValueError("its checksum differs")
        about = json_of(text)
        if about["format"] != FORMAT:
            raise ValueError(f"format {about['format']!r} instead of {FORMAT!r}")
        name, degree, background = str(about["scene"]), int(about["sh_degree"]), triple(about["background"])
        (number,) = (number for number, codec in CODECS.items() if codec.name == about["codec"])
        if not 0 <= degree <= 3:
            raise ValueError(f"SH degree {degree}")
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        reason = f"not the metadata of a 3dgs-coded scene ({error})"
        raise DataError(file, reason, "Save the model again") from error
    module = _format(number)
    gaussians = file.with_suffix(module.SUFFIX)
    scene = scene_of(module.read(gaussians).tables, name, background, degree, device)
    return scene, SavedScene(number, gaussians.read_bytes(), data)


def _through(number: int, scene: SceneGaussians) -> SceneGaussians:
    """A scene after coding and decoding."""
    with torch.no_grad(), own_streams(), tempfile.TemporaryDirectory() as folder:
        _write(Path(folder), number, scene, "scene")
        read, _ = _read(Path(folder, f"scene{_ABOUT}"), str(scene.means.device))
        return replace(read, name=scene.name)
