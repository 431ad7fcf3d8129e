"""Bitstream: time, and bits against the ideal.

    python -m tools.benchmarks.bench_bitstream [--anchors N] [--scenes N] [--repeats N] [--threads N]
                                               [--clouds FOLDER]

``--clouds`` also reports bits per position of every points3d.ply under a folder. What is compared runs in
turns in one process and the shortest times are shown: other work on the machine only makes them longer, the
sum over all threads ("CPU") less so.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from econgs_bench.datasets.cloud import read_ply
from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.model import Attributes, ContextConfig, ContextModel
from econgs_bench.econgs.codec.positions import PositionGrid, encode_positions, morton_order
from econgs_bench.econgs.codec.stream import decode_group, encode_group
from econgs_bench.econgs.splat import native
from tools.benchmarks.turns import interleaved

VOXEL = 0.001


def scenes_of(count: int, anchors: int) -> list[SceneAttributes]:
    """Anchors on wavy sheets, attributes that follow the position, as far as noise lets them."""
    random = np.random.default_rng(0)
    made = []
    for index in range(count):
        x, y = random.integers(-500, 500, (2, anchors))
        z = np.rint(300 * np.sin(x / 150 + index) * np.cos(y / 120)).astype(np.int64)
        positions = (np.unique(np.stack([x, y, z], 1), axis=0) * VOXEL).astype(np.float32)
        n = len(positions)
        wave = np.sin(6 * positions[:, :1] + np.arange(86)) * np.cos(5 * positions[:, 1:2])
        values = (wave + random.normal(size=(n, 86))).astype(np.float32)
        made.append(
            SceneAttributes(
                f"TF{index:02}",
                positions,
                0.2 * values[:, :50],
                (0.01 * np.exp(0.4 * values[:, 50:56])).astype(np.float32),
                values[:, 56:].reshape(n, 10, 3),
                {"palette": np.ones(3, np.float32), "embedding": np.zeros(50, np.float32)},
            )
        )
    return made


def attributes(scene: SceneAttributes) -> Attributes:
    return Attributes(*map(torch.from_numpy, (scene.features, scene.scalings, scene.offsets)))


def stream(count: int, anchors: int, repeats: int) -> dict[str, Any]:
    """Encoding and decoding of a group of scenes."""
    scenes = scenes_of(count, anchors)
    grid = PositionGrid.lattice(VOXEL, np.concatenate([one.positions for one in scenes]))
    model = ContextModel(ContextConfig(), torch.Generator().manual_seed(0))
    model.calibrate(*map(attributes, scenes))
    with torch.no_grad():
        model.refinements.weight.normal_(std=0.2, generator=torch.Generator().manual_seed(1))
    weights = np.random.default_rng(1).normal(size=29_980).astype(np.float32)
    group = GroupAttributes(tuple(scenes), grid, CodedContext.of(model), {"decoders": weights})
    encoded = encode_group(group)
    times = interleaved(
        {"encode": lambda: encode_group(group), "decode": lambda: decode_group(encoded.data)}, repeats
    )
    model.coder_exact = True
    estimate = sum(
        float(
            model.rounded(
                attributes(s), model.lookup(torch.from_numpy(grid.codes(s.positions)), grid.extent)
            )[1].sum()
        )
        for s in scenes
    )
    return {
        "scenes": count,
        "anchors": sum(map(len, scenes)),
        **{f"{name}, s": 1e-3 * time.shortest for name, time in times.items()},
        **{f"{name}, CPU, s": 1e-3 * time.cpu for name, time in times.items()},
        "bytes": len(encoded.data),
        "above the cross-entropy, %": 100 * (encoded.attribute_bits / encoded.ideal_bits - 1),
        "cross-entropy above the float model's estimate, %": 100 * (encoded.ideal_bits / estimate - 1),
        "bits per position": 8 * encoded.ledger["positions"] / sum(map(len, scenes)),
        **{f"ledger: {name}": size for name, size in encoded.ledger.items()},
    }


def clouds(folder: Path) -> dict[str, float]:
    """Bits per position of clouds, in the box at 16 bits per axis (48 raw) and on the lattice of anchors."""
    found = {}
    for path in sorted(folder.rglob("points3d.ply")):
        points = read_ply(path).points
        for name, grid in (
            ("16 bits per axis", PositionGrid.box(points.min(0), points.max(0))),
            (f"cells of {VOXEL:g}", PositionGrid.lattice(VOXEL, points)),
        ):
            codes = np.unique(grid.codes(points), axis=0)
            codes = codes[morton_order(codes)]
            found[f"{path.parent.name}, {name}"] = 8 * len(encode_positions(codes, grid)) / len(codes)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--anchors", type=int, default=14_000, help="per scene")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--clouds", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    native.set_threads(options.threads)
    results = {"stream": stream(options.scenes, options.anchors, options.repeats)}
    if options.clouds:
        results["bits per position"] = clouds(options.clouds)
    for title, numbers in results.items():
        print(title)
        for name, value in numbers.items():
            print(f"  {name:50} {value:12.4g}" if isinstance(value, float) else f"  {name:50} {value:12}")


if __name__ == "__main__":
    main()
