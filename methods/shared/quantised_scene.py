"""A scene of vector-quantised splats as one file: positions, codebooks and packed ids.

Positions are in half precision, or whole numbers on a grid, in whose Morton order all else follows, coded as
an octree. Ids have one length, or are entropy-coded where that is shorter.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.codebooks import Codebook, code_ids, decode_ids, decoded, pack_ids, unpack_ids
from econgs_bench.econgs.codec.positions import (
    PositionGrid,
    decode_positions,
    encode_positions,
    morton_order,
)
from econgs_bench.methods.shared.edits import triple
from econgs_bench.methods.shared.files import saved_files
from econgs_bench.methods.shared.sealed import read_tensors, write_tensors

SUFFIX = ".safetensors"
R = TypeVar("R")
Ids = Literal["fixed", "entropy"]
IDS, FIXED = "ids", "fixed"
"""Last parts of tensors' names: ids as the file says; ids of one length in a file of entropy-coded ones."""
MOST_CELLS = 1 << 20
"""Of a grid from 0 to the farthest position: single precision has 24 bits."""
Column = Tensor | tuple[Codebook, ...]
"""(N, width) values stored in half precision, or codebooks whose words add up to them."""


@dataclass(frozen=True, eq=False)
class QuantisedScene:
    """Content of a file.

    Attributes:
        name: the scene's name.
        background: its recorded background.
        about: further JSON values of the method.
        positions: (N, 3), exact in half precision, or places of the grid in Morton order.
        columns: name -> values; codebooks of single numbers have N x width ids, those of rows N.
        ids: how ids are stored: all of one length, or entropy-coded where that is shorter.
        grid: of the positions; None: they are stored in half precision.
    """

    name: str
    background: RGB
    about: Mapping[str, object]
    positions: Tensor
    columns: Mapping[str, Column]
    ids: Ids
    grid: PositionGrid | None = None

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
        tensors = {"positions": self._stored_positions()}
        parts = {"positions": _bytes(tensors["positions"]), "codebooks": 0}
        for name, column in self.columns.items():
            if isinstance(column, Tensor):
                tensors[name] = _half(column)
                parts[name] = _bytes(tensors[name])
                continue
            parts[name] = 0
            for stage, book in enumerate(column):
                end, data = self._stored_ids(book)
                words, ids = _half(book.words), _payload(data)
                tensors |= {f"{name}.{stage}.words": words, f"{name}.{stage}.{end}": ids}
                parts["codebooks"] += _bytes(words)
                parts[name] += _bytes(ids)
        about: dict[str, Any] = {
            "format": kind,
            "scene": self.name,
            "background": list(self.background),
            "ids": self.ids,
            "stages": {n: 0 if isinstance(c, Tensor) else len(c) for n, c in self.columns.items()},
            "about": self.about,
        }
        if self.grid is not None:
            about["grid"] = {"count": len(self.positions), **asdict(self.grid)}
        sizes = write_tensors(folder / f"{quote(self.name, safe=' ')}{SUFFIX}", tensors, about)
        return parts | {"metadata": sizes["metadata"]}

    def _stored_positions(self) -> Tensor:
        if self.grid is None:
            return _half(self.positions)
        return _payload(encode_positions(self.grid.codes(self.positions.cpu().numpy()), self.grid))

    def _stored_ids(self, book: Codebook) -> tuple[str, bytes]:
        """The last part of their tensor's name, and the ids."""
        packed = pack_ids(book)
        if self.ids == "fixed":
            return IDS, packed
        coded = code_ids(book)
        return (IDS, coded) if len(coded) < len(packed) else (FIXED, packed)


def placed(
    means: Tensor, log_scales: Tensor, share: float | None
) -> tuple[Tensor, Tensor, PositionGrid | None]:
    """Positions as a file keeps them.

    Args:
        means: (N, 3) of Gaussians.
        log_scales: (N, 3), natural logarithm of standard deviations.
        share: side of a cell of the grid, as a share of the median of the Gaussians' geometric mean scales;
            None: half precision.

    Returns:
        (N,) rows of the means in the order of the file, (N, 3) their positions, and the grid; on the CPU.
    """
    if share is None or not len(means):
        return torch.arange(len(means)), half_exact(means), None
    points = means.detach().cpu().numpy()
    cell = share * float(log_scales.detach().cpu().mean(1).median().exp())
    least = float(np.abs(points).max()) / MOST_CELLS
    grid = PositionGrid.lattice(float(f"{max(cell, least, 1e-9):.3g}"), points)
    codes = grid.codes(points)
    order = morton_order(codes)
    return torch.from_numpy(order), torch.from_numpy(grid.positions(codes[order])), grid


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
    positions, grid = _positions(tensors, about.get("grid"))
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
    return QuantisedScene(str(about["scene"]), background, about["about"], positions, columns, ids, grid)


def _positions(tensors: Mapping[str, Tensor], about: Any) -> tuple[Tensor, PositionGrid | None]:
    if about is None:
        return _halves(tensors, "positions", 3), None
    x, y, z = map(operator.index, about["extent"])
    grid = PositionGrid(triple(about["origin"]), triple(about["cell"]), (x, y, z))
    codes = decode_positions(_data(tensors, "positions"), operator.index(about["count"]), grid)
    return torch.from_numpy(grid.positions(codes)), grid


def _codebook(tensors: Mapping[str, Tensor], name: str, count: int, width: int, ids: Ids) -> Codebook:
    words = _halves(tensors, f"{name}.words", None)
    per_row = {width: 1, 1: width}.get(words.shape[1])
    if per_row is None:
        raise ValueError(f"{name} is no codebook of {width} numbers")
    packed = f"{name}.{FIXED}" in tensors
    read = unpack_ids if packed or ids == "fixed" else decode_ids
    data = _data(tensors, f"{name}.{FIXED if packed else IDS}")
    return Codebook(words, torch.from_numpy(read(data, count * per_row, len(words))))


def _payload(data: bytes) -> Tensor:
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _data(tensors: Mapping[str, Tensor], name: str) -> bytes:
    """Inverse of :func:`_payload`."""
    values = tensors[name]
    if values.dtype != torch.uint8 or values.ndim != 1:
        raise ValueError(f"{name} are no bytes")
    return values.numpy().tobytes()


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
