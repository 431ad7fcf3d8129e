"""The ground truth's alpha against Mitsuba's own volumetric path tracer, in a scene without light.

python -m tools.proofs.volpath [--resolution N] [--size N] [--samples N]

Mitsuba 3.9 has no media that emit, so what its ``volpath`` and the ground truth share is absorption: before a
white environment, an absorbing medium shows what passes, 1 - alpha. It interpolates extinctions, the ground
truth values: the finer the grid of extinctions, the less they differ.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.views import ViewRequest

_RUNS = 16
"""Independent pictures, whose spread is the path tracer's own error."""


def main() -> None:
    """Print the difference of the two, and the spread of the path tracer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=int, default=32, help="of the volume")
    parser.add_argument("--size", type=int, default=64, help="of the picture, pixels")
    parser.add_argument("--samples", type=int, default=4096, help="paths a pixel")
    parser.add_argument("--finer", type=int, default=6, help="samples of extinction per sample of the volume")
    parser.add_argument("--scene", action="append", help="which; default: all")
    options = parser.parse_args()
    dataset = open_dataset(f"vortices@{options.resolution}")
    heads = ("mean alpha", "difference", "its error", "RMS", "by noise")
    print(f"{'scene':<8}", *(f"{head:>12}" for head in heads))
    for scene in dataset.scenes:
        if scene.name not in (options.scene or [scene.name]):
            continue
        plain = replace(dataset, scenes=(replace(scene, light=None, depth_enhancement=0.0),), compositions={})
        request = ViewRequest("test", 12, 1, options.size, options.size, samples=64)
        views = views_of(plain, scene.name, request)
        ours = views.images[0, ..., 3].astype(np.float64)
        runs = _passing(plain, scene.name, views.cameras[0], options.samples, options.finer)
        theirs = 1.0 - runs.mean(axis=0)
        error = runs.std(axis=0, ddof=1) / np.sqrt(_RUNS)
        difference = theirs - ours
        means = runs.mean(axis=(1, 2))
        numbers = (
            ours.mean(), difference.mean(), means.std(ddof=1) / np.sqrt(_RUNS),
            np.sqrt((difference**2).mean()), np.sqrt((error**2).mean()),
        )  # fmt: skip
        print(f"{scene.name:<8}", *(f"{number:12.5f}" for number in numbers), flush=True)


def _passing(dataset: Dataset, scene: str, camera: Camera, samples: int, finer: int) -> NDArray[np.float64]:
    """(runs, height, width) share of the light behind the volume that comes through."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    one = dataset.scene(scene)
    volume = dataset.volume(one.variable)
    values = volume.normalised()
    shape = [(n - 1) * finer + 1 for n in values.shape]
    sigma = ndimage.zoom(values, [m / n for m, n in zip(shape, values.shape, strict=True)], order=1)
    for plane in sigma:
        plane[:] = one.transfer.classify(plane)[..., 3]
    low, high = volume.box
    grown = (
        (high - low) * np.array(shape[::-1]) / (np.array(shape[::-1]) - 1)
    )  # its samples lie in cells' middles
    transform = mi.ScalarTransform4f
    into = transform().translate((-0.5 * grown).tolist()).scale(grown.tolist())
    lens = np.asarray(camera.camera_to_world, dtype=np.float64) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    scene_of = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000},
        "sensor": {
            "type": "perspective", "fov_axis": "x", "to_world": transform(lens.tolist()), "near_clip": 1e-3,
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx))),
            "film": {
                "type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        },
        "behind": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
        "box": {
            "type": "cube", "to_world": transform().scale((0.5 * (high - low)).tolist()),
            "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous",
                "albedo": {"type": "constvolume", "value": {"type": "rgb", "value": 0.0}},
                "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(sigma[..., None]), "to_world": into},
            },
        },
    }  # fmt: skip
    loaded = mi.load_dict(scene_of)
    return np.stack([
        np.asarray(mi.render(loaded, spp=samples // _RUNS, seed=run))[..., 0].astype(np.float64)
        for run in range(_RUNS)
    ])  # fmt: skip


if __name__ == "__main__":
    main()
