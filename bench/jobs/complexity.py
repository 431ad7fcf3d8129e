"""The complexity job: how many bytes the classified volume of a scene takes without loss."""

from __future__ import annotations

import lzma
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.scene import SceneJob
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Count, Record, Result, Row
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

CODER = "LZMA2, preset 6, of differences along x (liblzma)"
_FILTERS: list[dict[str, Any]] = [
    {"id": lzma.FILTER_DELTA, "dist": 4},
    {"id": lzma.FILTER_LZMA2, "preset": 6},
]


class ComplexityResult(Result):
    """The volume of a scene as its transfer function shows it: 8-bit RGBA, coded without loss.

    Attributes:
        lossless_bytes: None for scenes of isosurfaces, which classify no volume.
        coder: what coded it.
    """

    voxels: Count
    lossless_bytes: Count | None
    coder: str


class Complexity(SceneJob):
    """Codes the volume of a scene as its transfer function shows it."""

    kind: Literal["complexity"] = "complexity"
    result_type = ComplexityResult

    @property
    def shown(self) -> Any:
        return self.identity.get("scene")

    def run(self, context: Context) -> ComplexityResult:
        """Code the volume as the transfer function shows it; isosurfaces classify none."""
        dataset = open_dataset(self.dataset)
        context.report(stage="loading")
        scene = dataset.scene(self.subject)
        volume = dataset.volume(scene.variable)
        context.report(stage="coding")
        return ComplexityResult(
            voxels=int(volume.values.size),
            lossless_bytes=None if scene.transfer is None else coded_bytes(volume, scene.transfer),
            coder=CODER,
        )

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        result = record.of(ComplexityResult)
        return {"complexity": [] if result is None else [result.model_dump()]}


def coded_bytes(volume: Volume, transfer: TransferFunction) -> int:
    """Bytes of the classified volume, x fastest, coded by :data:`CODER`; slice by slice, without a copy."""
    coder = lzma.LZMACompressor(lzma.FORMAT_RAW, filters=_FILTERS)
    count = 0
    for z, values in enumerate(volume.values):
        colors = classified(volume.normalise(values), transfer)
        if volume.mask is not None:
            colors[~volume.mask[z]] = 0
        count += len(coder.compress(colors.tobytes()))
    return count + len(coder.flush())


def classified(values: NDArray[np.floating], transfer: TransferFunction) -> NDArray[np.uint8]:
    """values.shape + (4,): color and opacity of the reference length in 8 bits, no color without opacity."""
    shown = transfer.classify(values)
    shown[..., 3] = -np.expm1(-shown[..., 3] * transfer.reference_length)
    colors: NDArray[np.uint8] = np.rint(255.0 * shown).astype(np.uint8)
    colors[colors[..., 3] == 0] = 0
    return colors
