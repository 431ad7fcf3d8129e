"""Small groups of scenes for the tests of the bitstream, made without any training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.hash_grid import GridConfig
from econgs_bench.econgs.codec.integer import IntegerHead, IntegerIntra, IntegerLayer
from econgs_bench.econgs.codec.model import ContextConfig
from econgs_bench.econgs.codec.positions import PositionGrid

GRID = GridConfig(volume=(3, 7, 12), planes=(6, 9), volume_log2=8, planes_log2=6)
CONFIG = ContextConfig(features=8, offsets=3, steps=(0.125, 0.001, 0.001, 0.2), grid=GRID, hidden=12)


def coded_context(config: ContextConfig = CONFIG, seed: int = 0, wild: bool = False) -> CodedContext:
    """A context model with integer weights drawn by integers: the same on every machine.

    Args:
        wild: weights, exponents and biases anywhere in their ranges.
    """
    random = np.random.default_rng(seed)

    def layer(rows: int, inputs: int, exponent: tuple[int, int], bias: np.ndarray) -> IntegerLayer:
        return IntegerLayer(
            random.integers(-127, 128, (rows, inputs)).astype(np.int8),
            random.integers(*exponent, rows, endpoint=True).astype(np.int8),
            bias.astype(np.int32),
        )

    logits = config.features if config.chunk else 0
    rows = 2 * config.total + 4 + logits
    bias = np.zeros(rows)
    bias[config.total : 2 * config.total] = random.integers(-65536, 3 * 65536, config.total)
    hidden = random.integers(-65536, 65536, config.hidden)
    if wild:
        bias, hidden = (random.integers(-(2**31) + 1, 2**31, one.shape) for one in (bias, hidden))
    head = IntegerHead(
        layer(config.hidden, config.grid.outputs, (-16, 20) if wild else (8, 9), hidden),
        layer(rows, config.hidden, (-16, 20) if wild else (8, 10), bias),
        config.widths,
    )
    positive = random.integers(0, 4, (config.grid.entries, config.grid.features)) > 0
    if not config.chunk:
        return CodedContext(config, head, positive)

    def outputs(width: int) -> np.ndarray:
        parts = (-(2**20), 2**20), (-65536, 3 * 65536), (-(2**18), 2**18)
        return np.concatenate([random.integers(*bounds, width) for bounds in parts])

    before = np.cumsum(config.chunks)[:-1].tolist()
    layers = tuple(
        (
            layer(7, one, (-16, 20) if wild else (8, 10), random.integers(-65536, 65536, 7)),
            layer(3 * width, 7, (-16, 20) if wild else (8, 10), outputs(width)),
        )
        for one, width in zip(before, config.chunks[1:], strict=True)
    )
    units = random.integers(-3, 4, config.features).astype(np.int8)
    intra = IntegerIntra(config.chunks, units, outputs(config.chunks[0]).astype(np.int32), layers)
    return CodedContext(config, head, positive, intra)


def scene(name: str, count: int, grid: PositionGrid, config: ContextConfig, seed: int) -> SceneAttributes:
    """Anchors anywhere; attributes are fractions of small whole numbers, the same on every machine."""
    random = np.random.default_rng(seed)
    codes = random.integers(0, np.array(grid.extent) + 1, (count, 3))

    def numbers(scale: float, *shape: int) -> np.ndarray:
        return (random.integers(-1000, 1001, (count, *shape)) * np.float32(scale)).astype(np.float32)

    return SceneAttributes(
        name,
        grid.positions(codes),
        numbers(2.0**-10, config.features),
        np.abs(numbers(2.0**-16, 6)),
        numbers(2.0**-9, config.offsets, 3),
        {"palette": np.array([0.25, 0.5, 1.0], np.float32), "embedding": np.arange(5, dtype=np.float32) / 8},
    )


def group(
    counts: tuple[int, ...] = (60, 0, 25), context: CodedContext | None = None, **more: Any
) -> GroupAttributes:
    """Scenes of so many anchors, by default with a context model."""
    grid = PositionGrid((-0.5, -0.25, 0.0), (1 / 1024, 1 / 1024, 1 / 512), (1000, 700, 300))
    context = context or coded_context()
    random = np.random.default_rng(5)
    decoders = {
        "opacity/weight": (random.integers(-500, 500, (4, 6)) / 1024).astype(np.float32),
        "opacity/bias": (random.integers(-500, 500, 4) / 1024).astype(np.float32),
    }
    scenes = tuple(scene(f"TF{i}", count, grid, context.config, i) for i, count in enumerate(counts))
    return GroupAttributes(scenes, grid, context, decoders, {"offsets": 3, "color": "tanh"} | more)


def arrays_of(one: GroupAttributes) -> list[np.ndarray]:
    """All arrays of a group in a fixed order."""
    arrays = [one.decoders[name] for name in sorted(one.decoders)]
    for each in one.scenes:
        arrays += [each.positions, each.features, each.scalings, each.offsets]
        arrays += [each.parameters[name] for name in sorted(each.parameters)]
    return arrays


def attribute_tensors(one: SceneAttributes) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, scalings and offsets as tensors."""
    return tuple(torch.from_numpy(a.copy()) for a in (one.features, one.scalings, one.offsets))  # type: ignore[return-value]


def with_culling(one: GroupAttributes) -> GroupAttributes:
    """The group with a decoder that culls about half of its Gaussians."""
    assert one.context is not None
    random = np.random.default_rng(11)
    config, embedding, hidden = one.context.config, 5, 7

    def numbers(*shape: int) -> np.ndarray:
        return (random.integers(-1000, 1001, shape) / 1024).astype(np.float32)

    decoders = one.decoders | {
        "opacity.first_weight": numbers(hidden, config.features + embedding),
        "opacity.first_bias": numbers(hidden),
        "opacity.second_weight": numbers(config.offsets, hidden),
        "opacity.second_bias": 1.5 + numbers(config.offsets),
    }
    return replace(one, decoders=decoders, culling=True)


def with_masks(one: GroupAttributes) -> GroupAttributes:
    """The group with about a third of its offsets masked, and all of one anchor's."""
    random = np.random.default_rng(9)
    scenes = []
    for scene in one.scenes:
        masks = random.integers(0, 3, scene.offsets.shape[:2]) > 0
        masks[:1] = False
        scenes.append(replace(scene, masks=masks))
    return replace(one, scenes=tuple(scenes))
