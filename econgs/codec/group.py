"""A group of scenes that share decoders and a context model, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from econgs_bench.econgs.codec.arrays import Arrays
from econgs_bench.econgs.codec.hash_grid import interpolate, make_lookup
from econgs_bench.econgs.codec.integer import (
    Coding,
    IntegerHead,
    IntegerIntra,
    joined,
    step_sizes,
    whole_values,
)
from econgs_bench.econgs.codec.model import ContextConfig, ContextModel
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.codec.symbols import columns_of

_PIECE = 8192  # anchors per lookup


@dataclass(frozen=True)
class CodedContext:
    """A context model in its coded form.

    Attributes:
        config: sizes; steps rounded to float32.
        head: integer weights.
        positive: (entries, features) True for the bits +1 of the hash grid.
        intra: networks between features; only where these are mixtures.
    """

    config: ContextConfig
    head: IntegerHead
    positive: NDArray[np.bool_]
    intra: IntegerIntra | None = None

    @classmethod
    def of(cls, model: ContextModel) -> CodedContext:
        """Coded form of a trained model on any device."""
        a, b, c, d = (float(np.float32(one)) for one in model.config.steps)
        positive = (model.grid.table.detach() >= 0.0).cpu().numpy()
        config = replace(model.config, steps=(a, b, c, d))
        return cls(config, model.integer_head(), positive, model.integer_intra())

    def coding(self, codes: NDArray[np.int64], grid: PositionGrid) -> Coding:
        """Coding parameters of anchors at (N, 3) position codes."""
        table = torch.from_numpy(np.where(self.positive, np.float32(1), np.float32(-1)))
        parts = []
        with torch.no_grad():
            for begin in range(0, max(len(codes), 1), _PIECE):
                piece = torch.from_numpy(codes[begin : begin + _PIECE])
                lookup = make_lookup(self.config.grid, piece, grid.extent)
                values, _ = interpolate(table, lookup)
                parts.append(self.head(whole_values(values)))
        return joined(parts)

    def steps(self, coding: Coding) -> NDArray[np.float32]:
        """(N, D) step of every element."""
        each = [
            step_sizes(coding.steps[:, group], base)[:, None].repeat(width, 1)
            for group, (base, width) in enumerate(zip(self.config.steps, self.config.widths, strict=True))
        ]
        return np.concatenate(each, 1)


@dataclass(frozen=True)
class SceneAttributes:
    """One scene: N anchors and the scene's own parameters.

    Attributes:
        name: name of the scene.
        positions: (N, 3) float32, on the group's grid of positions.
        features: (N, F) float32.
        scalings: (N, 6) float32, activated.
        offsets: (N, K, 3) float32.
        parameters: further float32 arrays by name: palette, embedding.
        masks: (N, K) True for existing offsets; the others become 0 and take no bits. None: all exist.
    """

    name: str
    positions: NDArray[np.float32]
    features: NDArray[np.float32]
    scalings: NDArray[np.float32]
    offsets: NDArray[np.float32]
    parameters: Arrays = field(default_factory=dict)
    masks: NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def values(self) -> NDArray[np.float32]:
        """(N, D): features, scalings, offsets."""
        flat = self.offsets.reshape(len(self), self.offsets.shape[1] * self.offsets.shape[2])
        return np.concatenate([self.features, self.scalings, flat], 1, dtype=np.float32)

    def with_values(self, values: NDArray[np.float32]) -> SceneAttributes:
        """The scene with other attributes (N, D), in the order of :attr:`values`."""
        many = self.offsets.shape[1]
        features, scalings, offsets = columns_of(self.features.shape[1], many)
        return replace(
            self,
            features=values[:, features],
            scalings=values[:, scalings],
            offsets=values[:, offsets].reshape(len(values), many, 3),
        )


@dataclass(frozen=True)
class GroupAttributes:
    """Scenes that share decoders and a context model.

    Attributes:
        scenes: one or more scenes with equal numbers of features and offsets.
        grid: grid of the anchor positions.
        context: None stores attributes as plain float32.
        decoders: weights of the shared decoders by name, float32.
        metadata: JSON object (options for the renderer).
        culling: whether offsets of Gaussians that the decoder ``opacity`` culls become 0 and take no bits
            (:mod:`.econgs.codec.culling`); only with context and without masks.
        plain_positions: whether positions are stored as float32, not coded.
    """

    scenes: tuple[SceneAttributes, ...]
    grid: PositionGrid
    context: CodedContext | None = None
    decoders: Arrays = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    culling: bool = False
    plain_positions: bool = False

    @property
    def masked(self) -> bool:
        """Whether the scenes have masks."""
        return self.scenes[0].masks is not None

    @property
    def mixtures(self) -> bool:
        """Whether features are mixtures."""
        return self.context is not None and self.context.intra is not None
