"""Fits blobs to the training views: optical depths by SIRT, as in tomography, colors by weighted means."""

import json
import sys
from pathlib import Path

import numpy as np
from blobs import footprints, picture, save
from PIL import Image


def back(image, rows, columns):
    """Sum of a picture (height, width) under each blob: the adjoint of drawing."""
    return ((image.T @ rows) * columns).sum(axis=0)


def main(views, out, iterations, seed, count):
    """Train on the views of a folder and write a PLY."""
    generator = np.random.default_rng(seed)
    frames = json.loads((views / "transforms_train.json").read_text())["frames"]
    pictures = [np.asarray(Image.open(views / (f["file_path"] + ".png"))) / 255.0 for f in frames]
    fields = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), ("rgb", "u1", 3)]
    cloud = np.frombuffer((views / "points3d.ply").read_bytes().partition(b"end_header\n")[2], fields)
    cloud = cloud[generator.permutation(len(cloud))[:count]]
    points = np.stack([cloud[name] for name in "xyz"], axis=-1).astype(np.float64)
    colors = cloud["rgb"] / 255.0
    sigma = 0.25 * ((np.ptp(points, axis=0) + 1e-3).prod() / len(points)) ** (1 / 3)
    depth = np.full(len(points), 0.02)
    for iteration in range(1, iterations + 1):
        view = generator.integers(len(frames))
        alpha, target = pictures[view][..., 3], pictures[view][..., :3]
        rows, columns = footprints(points, sigma, frames[view])
        total, mean = picture(depth, colors, rows, columns)
        error = -np.log1p(-np.minimum(alpha, 0.995)) - total
        depth += 0.5 * back(error, rows, columns) / back(rows @ columns.T, rows, columns)
        depth = np.maximum(depth, 1e-6)
        weight = alpha / (total + 1e-3)
        change = [back(weight * one, rows, columns) for one in np.moveaxis(target - mean, -1, 0)]
        colors += 0.5 * np.stack(change, axis=-1) / (back(weight, rows, columns)[:, None] + 1e-6)
        colors = colors.clip(0.0, 1.0)
        drawn = -np.expm1(-total)
        wrong = drawn[..., None] * mean - alpha[..., None] * target
        loss = np.mean((drawn - alpha) ** 2) + np.mean(wrong**2)
        print(f"iteration {iteration} loss {loss:.6f}", flush=True)
    save(out / "point_cloud.ply", points, sigma, depth, colors)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
