"""Modes of ground truth: error against the oracle, convergence with the step, cost.

Run: ``python -m tools.benchmarks.bench_ground_truth_modes [accuracy] [convergence] [cost]`` (default: all).
Figures are printed as Markdown.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter

from econgs_bench.datasets.ground_truth.model import Layer, MarchSettings
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.datasets.marching import around, mitsuba
from tools.benchmarks.turns import heading, interleaved, row

PHONG = Light(model="phong")
FIXED = Light(direction=(0.6, 0.0, 0.8))


def shells(n: int, seed: int = 0) -> Volume:
    """Wobbling nested shells."""
    x = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    z, y, x = np.meshgrid(x, x, x, indexing="ij", sparse=True)
    radius = np.sqrt(x * x + y * y + z * z)
    noise = np.random.default_rng(seed).standard_normal((n, n, n)).astype(np.float32)
    wobble = gaussian_filter(noise, n / 16, mode="wrap")
    values = 1.1 - radius + 0.25 * wobble / np.abs(wobble).max()
    return Volume("shells", np.clip(values, 0.0, 1.0), (1.0, 1.0, 1.0), (0.0, 1.0), "made here")


def modes(n: int) -> dict[str, list[Layer]]:
    """The layers of a scene of each mode."""
    first, second = shells(n), shells(n, seed=1)
    low, high = (
        TransferFunction("t", (Bump("b", a, a + 0.03, a + 0.07, a + 0.1, color, opacity),))
        for a, color, opacity in ((0.4, (0.9, 0.5, 0.2), 0.3), (0.65, (0.2, 0.5, 0.9), 0.7))
    )
    both = replace(low, bumps=low.bumps + high.bumps)
    z, y, x = np.indices((n, n, n), sparse=True)
    masked = replace(first, mask=(x + 2 * y - z) < 1.1 * n)
    levels = (
        Isosurface("outer", 0.45, (0.9, 0.5, 0.2), 0.4),
        Isosurface("inner", 0.7, (0.2, 0.5, 0.9), 1.0),
    )
    return {
        "unshaded": [Layer(first, both, None)],
        "Blinn-Phong": [Layer(first, both, Light())],
        "Phong": [Layer(first, both, PHONG)],
        "composition, one volume": [Layer(first, low, Light()), Layer(first, high, FIXED)],
        "composition, two volumes": [Layer(first, low, Light()), Layer(second, high, FIXED)],
        "mask": [Layer(masked, both, Light())],
        "depth-enhanced": [Layer(first, both, Light(), (), 1.0)],
        "isosurfaces": [Layer(first, None, Light(), levels)],
        "isosurface in a volume": [Layer(first, None, Light(), levels[1:]), Layer(second, low, Light())],
    }


def marcher(layers: list[Layer], step: float = MarchSettings.step_voxels, leap: bool = True):
    return mitsuba([layer.volume for layer in layers], MarchSettings(step_voxels=step), leap=leap)


def accuracy() -> None:
    heading(
        "Mitsuba against the float64 oracle, shells of 64^3, two views of 96^2",
        "mode", "RMS", "max", "pixels over 2e-4", "bricks off",
    )  # fmt: skip
    for name, layers in modes(64).items():
        views = around(layers[0].volume, 96, 42, (3, 17))
        image = marcher(layers).compose(views, layers)
        oracle = ReferenceMarcher([layer.volume for layer in layers])
        exact = np.stack([oracle.compose_exact(camera, layers).numpy() for camera in views])
        error = np.abs(image - exact)
        over = int((error.max(axis=-1) > 2e-4).sum())
        same = np.array_equal(image, marcher(layers, leap=False).compose(views, layers))
        rms = np.sqrt((error**2).mean())
        row(name, f"{rms:.1e}", f"{error.max():.1e}", over, "identical" if same else "DIFFERS")


def convergence() -> None:
    steps = (2.0, 1.0, 0.5, 0.25, 0.125)
    heading(
        "PSNR (dB, white background) to a step of 1/32 voxel, shells of 128^3, two views of 200^2",
        "mode", *map(str, steps),
    )  # fmt: skip
    for name, layers in modes(128).items():
        views = around(layers[0].volume, 200, 42, (3, 17))
        seen = {}
        for step in (*steps, 1 / 32):
            image = marcher(layers, step).compose(views, layers)
            seen[step] = image[..., :3] + 1.0 - image[..., 3:]
        errors = [np.mean((seen[step] - seen[1 / 32]) ** 2, dtype=np.float64) for step in steps]
        row(name, *(f"{-10 * np.log10(error):.1f}" for error in errors))


def cost() -> None:
    volume_setup, scene_setup, ways = {}, {}, {}
    for name, layers in modes(256).items():
        start = time.perf_counter()
        held = marcher(layers)
        ready = time.perf_counter()
        draw = held.prepare(layers)
        volume_setup[name], scene_setup[name] = ready - start, time.perf_counter() - ready
        ways[name] = partial(draw, around(layers[0].volume, 400, 42, (3, 4, 5, 6)))
    times = interleaved(ways, turns=4, views=4)
    heading(
        "Cost, ms per view: shells of 256^3, 400^2, four views in a launch, least of four turns",
        "mode", "ms", "ms of CPU", "to Blinn-Phong (CPU)", "volume set up, s", "scene set up, s",
    )  # fmt: skip
    for name, one in times.items():
        ratio = one.cpu / times["Blinn-Phong"].cpu
        setup = f"{volume_setup[name]:.1f}", f"{scene_setup[name]:.2f}"
        row(name, f"{one.shortest:.0f}", f"{one.cpu:.0f}", f"{ratio:.2f} x", *setup)


if __name__ == "__main__":
    parts = {"accuracy": accuracy, "convergence": convergence, "cost": cost}
    for part in sys.argv[1:] or parts:
        parts[part]()
