"""The attributes of a scene as whole multiples of their steps, in the order in which a stream has them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.coder import SYMBOL_LIMIT
from econgs_bench.econgs.codec.culling import kept_offsets
from econgs_bench.econgs.codec.group import GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.integer import Coding, IntegerIntra
from econgs_bench.econgs.codec.positions import morton_order
from econgs_bench.econgs.codec.symbols import SCALINGS, Present, columns_of


@dataclass(frozen=True)
class Quantised:
    """A scene in Morton order: position codes, symbols (N, D) and their coding (None without context).

    Of the offsets, those that are present have symbols; None: all.
    """

    scene: SceneAttributes
    codes: NDArray[np.int64]
    symbols: NDArray[np.int32] | None
    coding: Coding | None
    present: Present | None
    intra: IntegerIntra | None = None


def quantise(scene: SceneAttributes, group: GroupAttributes) -> Quantised:
    """A scene of a group in Morton order, its attributes rounded to multiples of their steps.

    Raises:
        DataError: values that are not finite or far beyond their steps, or an anchor outside the grid.
    """
    codes = _checked(scene, group)
    order = morton_order(codes)
    codes = codes[order]
    arrays = (scene.features, scene.scalings, scene.offsets)
    features, scalings, offsets = (np.ascontiguousarray(one[order], np.float32) for one in arrays)
    masks = None if scene.masks is None else scene.masks[order]
    if masks is not None:
        offsets = np.where(masks[..., None], offsets, np.float32(0))
    ordered = replace(
        scene,
        positions=group.grid.positions(codes),
        features=features,
        scalings=scalings,
        offsets=offsets,
        parameters={name: np.asarray(one, np.float32) for name, one in scene.parameters.items()},
        masks=masks,
    )
    if group.context is None:
        return Quantised(ordered, codes, None, None, masks)
    coding = group.context.coding(codes, group.grid)
    steps = group.context.steps(coding)
    symbols = np.floor(ordered.values.astype(np.float64) / steps + 0.5)
    if symbols.size and np.abs(symbols).max() >= SYMBOL_LIMIT:
        worst = np.unravel_index(np.abs(symbols).argmax(), symbols.shape)
        raise DataError(
            f"scene {scene.name}",
            f"an attribute ({worst[1]}) is {ordered.values[worst]:g}, over 2^24 steps of {steps[worst]:g}",
            "Training has diverged, or the base step is too small",
        )
    whole = symbols.astype(np.int32)
    if group.culling:
        coded, _, offset_columns = columns_of(features.shape[1], offsets.shape[1])
        values = whole[:, coded].astype(np.float32) * steps[:, coded]
        masks = kept_offsets(group.decoders, values, ordered.parameters)
        whole[:, offset_columns][~masks.repeat(3, 1)] = 0
    rounded = ordered.with_values(whole.astype(np.float32) * steps)
    return Quantised(rounded, codes, whole, coding, masks, group.context.intra)


def _checked(scene: SceneAttributes, group: GroupAttributes) -> NDArray[np.int64]:
    """Position codes of a scene, after checks."""
    count = len(scene)
    first = group.scenes[0]
    width, many = first.features.shape[1], first.offsets.shape[1]
    shapes = {
        "positions": (count, 3),
        "features": (count, width),
        "scalings": (count, SCALINGS),
        "offsets": (count, many, 3),
    }
    remedy = "Training has gone wrong before"
    for name, shape in shapes.items():
        array = getattr(scene, name)
        if array.shape != shape:
            raise DataError(f"scene {scene.name}", f"{name} have shape {array.shape}, not {shape}", remedy)
        if not np.isfinite(array).all():
            raise DataError(f"scene {scene.name}", f"{name} hold a value that is not finite", remedy)
    if scene.masks is not None and scene.masks.shape != (count, many):
        reason = f"masks have shape {scene.masks.shape}, not {(count, many)}"
        raise DataError(f"scene {scene.name}", reason, remedy)
    context = group.context
    if context is not None and (context.config.features, context.config.offsets) != (width, many):
        raise DataError(f"scene {scene.name}", "the context model is for other features or offsets", remedy)
    codes = group.grid.codes(scene.positions)
    away = np.abs(group.grid.positions(codes) - scene.positions)
    if (away > np.asarray(group.grid.cell) * 0.51 + 1e-5).any():
        raise DataError(f"scene {scene.name}", "an anchor lies outside the grid of positions", remedy)
    return codes


def round_group(group: GroupAttributes) -> GroupAttributes:
    """The group after encoding and decoding (decoders at full precision), without coding."""
    scenes = tuple(quantise(scene, group).scene for scene in group.scenes)
    decoders = {name: np.asarray(one, np.float32) for name, one in group.decoders.items()}
    return replace(group, scenes=scenes, decoders=decoders)
