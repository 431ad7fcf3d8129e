"""Isolated pieces of a scene that models lack: the pictures of a run store against their ground truth.

bench run tools/benchmarks/lost_pieces.toml --out DIR
python -m tools.benchmarks.lost_pieces --runs DIR

A piece is a connected region of a test view's alpha, of four pixels at least. It is lost where the model
draws less than a quarter of its alpha.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from econgs_bench.bench.api import Runs

VISIBLE = 0.02  # alpha
PIXELS = 4
KEPT = 0.25


def main() -> None:
    """Print pieces, lost ones and the pixels of these, for each model of a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="run store that still has its pictures")
    root = parser.parse_args().runs
    print("| dataset | scene | method | variant | seed | pieces | lost | pixels of these |\n|" + "---|" * 8)
    views = Runs(root).tables["views"].query("rate.isna()")  # not what is thinned without a fit of its own
    names = ["dataset", "scene", "method", "variant", "seed"]
    for cell, group in views.fillna({"variant": ""}).groupby(names, sort=False):
        files = zip(group["truth_file"], group["render_file"], strict=True)
        counts = np.sum([_lost(_alpha(root / truth), _alpha(root / drawn)) for truth, drawn in files], axis=0)
        print("| " + " | ".join(map(str, (*cell, *counts))) + " |")


def _alpha(file: Path) -> NDArray[np.float64]:
    return np.asarray(Image.open(file).convert("RGBA"))[..., 3] / 255.0


def _lost(truth: NDArray[np.float64], drawn: NDArray[np.float64]) -> tuple[int, int, int]:
    """Pieces of a view, lost ones, and pixels of these."""
    labels, count = ndimage.label(truth > VISIBLE, np.ones((3, 3)))
    every = np.arange(1, count + 1)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    there, left = (np.asarray(ndimage.sum(one, labels, every)) for one in (truth, drawn))
    pieces = sizes >= PIXELS
    lost = pieces & (left < KEPT * there)
    return int(pieces.sum()), int(lost.sum()), int(sizes[lost].sum())


if __name__ == "__main__":
    main()
