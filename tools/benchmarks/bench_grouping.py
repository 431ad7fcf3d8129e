"""Finding the groups of joint learning: seconds for the 41 scenes of ``jet_flame``, and how near to exact.

python -m tools.benchmarks.bench_grouping [--dataset NAME] [--repeats N]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import initial_cloud
from econgs_bench.econgs.grouping import chamfer_distances, cluster


def main() -> None:
    """Print one line per sample size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", default="jet_flame")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    dataset = open_dataset(options.dataset)
    clouds = [initial_cloud(dataset, scene.name, 10_000, 0).points for scene in dataset.scenes]
    exact = chamfer_distances(clouds, sample=10**9)
    apart = exact > 0.003  # nearer scenes merge at any threshold in use
    for sample in (256, 512, 2048):
        best = float("inf")
        for _ in range(options.repeats):
            start = time.perf_counter()
            found = chamfer_distances(clouds, sample=sample)
            groups = cluster(found, 0.01)
            best = min(best, time.perf_counter() - start)
        errors = np.abs(found[apart] / exact[apart] - 1.0)
        told = f"error median {np.median(errors):.1%}, max {errors.max():.1%}" if apart.any() else "all near"
        print(
            f"{len(clouds)} scenes, {sample} points each: {best:.2f} s, {len(groups)} groups; {told}",
            flush=True,
        )


if __name__ == "__main__":
    main()
