"""A scene of vector-quantised splats as one file: half-precision positions, codebooks and packed ids."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar
from urllib.parse import quote

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from datasets.errors import DataError
from datasets.scene import RGB
from econgs.codebooks import Codebook, code_ids, decode_ids, decoded, pack_ids, unpack_ids
from methods.shared.edits import triple
from methods.shared.files import saved_files
from methods.shared.sealed import read_tensors, write_tensors

SUFFIX = ".safetensors"
R = TypeVar("R")
Ids = Literal["fixed", "entropy"]
Column = Tensor | tuple[Codebook, ...]
"""(N, width) values stored in half precision, or codebooks whose words add up to them."""


@dataclass(frozen=True, eq=False)
class QuantisedScene:
    """Content of a file.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        about: further JSON values of the method.
        positions: (N, 3), exact in half precision.
        columns: name -> values; codebooks of single numbers have N x width ids, those of rows N.
        ids: how ids are stored: all of one length, or entropy-coded.
    """

    name: str
    background: RGB
    about: Mapping[str, object]
    positions: Tensor
    columns: Mapping[str, Column]
    ids: Ids

    def column(self, name: str, width: int) -> Tensor:
        """(N, width) values of a column."""
        column = self.columns[name]
        if isinstance(column, Tensor):
            return column
        return decoded(column).reshape(len(self.positions), width)

    def write(self, folder: Path, kind: str) -> dict[str, int]:
        """Write ``<scene>.safetensors``.

        Args:
            folder: where to.
            kind: name and version of the format.

        Returns:
            Bytes by part ("positions", each column's ids or values, "codebooks", "metadata"), which sum to
            the size of the file.
        """
        tensors: dict[str, Tensor] = {"positions": _half(self.positions)}
        parts = {"positions": _bytes(tensors["positions"]), "codebooks": 0}
        for name, column in self.columns.items():
            if isinstance(column, Tensor):
                tensors[name] = _half(column)
                parts[name] = _bytes(tensors[name])
                continue
            parts[name] = 0
            for stage, book in enumerate(column):
                data = pack_ids(book) if self.ids == "fixed" else code_ids(book)
                words = _half(book.words)
                packed = torch.from_numpy(np.frombuffer(data, np.uint8).copy())
                tensors |= {f"{name}.{stage}.words": words, f"{name}.{stage}.ids": packed}
                parts["codebooks"] += _bytes(words)
                parts[name] += _bytes(packed)
        about = {
            "format": kind,
            "scene": self.name,
            "background": list(self.background),
            "ids": self.ids,
            "stages": {n: 0 if isinstance(c, Tensor) else len(c) for n, c in self.columns.items()},
            "about": self.about,
        }
        sizes = write_tensors(folder / f"{quote(self.name, safe=' ')}{SUFFIX}", tensors, about)
        return parts | {"metadata": sizes["metadata"]}


def read_folder(
    folder: Path, method: str, kind: str, widths: Mapping[str, int], ready: Callable[[QuantisedScene], R]
) -> list[tuple[QuantisedScene, R]]:
    """The scenes of a folder that a method saved, as they are stored (on the CPU) and ready to render.

    Args:
        folder: the model's folder.
        method: name, for messages.
        kind: name and version of the format.
        widths: column -> numbers per Gaussian.
        ready: makes a scene ready to render; raises ``ValueError``, ``KeyError`` or ``TypeError`` where it is
            not one of the method's.

    Raises:
        DataError: no scene is there, or a file is damaged or of another kind.
    """
    scenes = []
    for file in saved_files(folder, SUFFIX, method):
        try:
            scene = _read(file, kind, widths)
            scenes.append((scene, ready(scene)))
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise DataError(file, f"not a scene of {method} ({error})", "Save the model again") from error
    return scenes


def _read(file: Path, kind: str, widths: Mapping[str, int]) -> QuantisedScene:
    about, tensors = read_tensors(file, kind)
    ids = about["ids"]
    if ids not in ("fixed", "entropy"):
        raise ValueError(f"ids {ids!r}")
    background = triple(about["background"])
    positions = _halves(tensors, "positions", 3)
    columns: dict[str, Column] = {}
    for name, width in widths.items():
        stages = int(about["stages"][name])
        if stages == 0:
            columns[name] = _halves(tensors, name, width)
            if len(columns[name]) != len(positions):
                raise ValueError(f"{name} has another number of rows than positions")
        else:
            columns[name] = tuple(
                _codebook(tensors, f"{name}.{stage}", len(positions), width, ids) for stage in range(stages)
            )
    return QuantisedScene(str(about["scene"]), background, about["about"], positions, columns, ids)


def _codebook(tensors: Mapping[str, Tensor], name: str, count: int, width: int, ids: Ids) -> Codebook:
    words = _halves(tensors, f"{name}.words", None)
    per_row = {width: 1, 1: width}.get(words.shape[1])
    packed = tensors[f"{name}.ids"]
    if per_row is None or packed.dtype != torch.uint8 or packed.ndim != 1:
        raise ValueError(f"{name} is no codebook of {width} numbers")
    read = unpack_ids if ids == "fixed" else decode_ids
    numbers = read(packed.numpy().tobytes(), count * per_row, len(words))
    return Codebook(words, torch.from_numpy(numbers))


def _halves(tensors: Mapping[str, Tensor], name: str, width: int | None) -> Tensor:
    values = tensors[name]
    fits = values.ndim == 2 and values.dtype == torch.float16 and width in (None, values.shape[1])
    if not fits or not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} is no table of finite half-precision numbers")
    return values.float()


def half_exact(values: Tensor) -> Tensor:
    """Values as half precision keeps them."""
    return _half(values).float()


def _half(values: Tensor) -> Tensor:
    largest = torch.finfo(torch.float16).max
    return values.detach().cpu().clamp(-largest, largest).half().contiguous()


def _bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()
